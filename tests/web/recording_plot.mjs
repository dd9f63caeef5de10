// In the place of the library that draws time series: it keeps what it is given, and puts seconds
// along its width.

import { PageElement } from "./page_document.mjs";
import { RecordingContext } from "./recording_canvas.mjs";

export const WIDTH = 300;

export class Plot {
  static install() {
    Plot.made = [];
    globalThis.uPlot = Plot;
  }

  constructor(options, data, box) {
    Object.assign(this, { options, data, box, cursor: { left: 0 }, isDestroyed: false });
    this.over = new PageElement("div", globalThis.document);
    this.bbox = { left: 10, top: 5, width: WIDTH, height: 80 };
    this.ctx = new RecordingContext();
    Plot.made.push(this);
  }

  get range() {
    return this.options.scales.x.range();
  }

  setData(data) {
    this.data = data;
  }

  setSize(size) {
    this.size = size;
  }

  destroy() {
    this.isDestroyed = true;
  }

  posToVal(px) {
    const [from, to] = this.range;
    return from + ((to - from) * px) / WIDTH;
  }

  valToPos(value) {
    const [from, to] = this.range;
    return this.bbox.left + (WIDTH * (value - from)) / (to - from);
  }
}
