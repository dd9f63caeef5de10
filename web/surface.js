// A canvas that keeps its size, its sharpness and the colours of the theme.

/** Colours by name, read from the style sheet. */
export function readColours(names) {
  const style = getComputedStyle(document.documentElement);
  return Object.fromEntries(
    names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]),
  );
}

export const fontOf = () =>
  getComputedStyle(document.documentElement).getPropertyValue("--font").trim() || "sans-serif";

export class Surface {
  constructor(canvas, colourNames, draw) {
    Object.assign(this, { canvas, colourNames, draw, context: canvas.getContext("2d") });
    this.shown = undefined;
    this.isDrawn = false; // whether what is to be shown could be drawn
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.recolour();
  }

  recolour() {
    this.colour = readColours(this.colourNames);
    this.font = fontOf();
    this.redraw();
  }

  /** Asked here alone: in the middle of a refresh the answer would cost a layout. */
  resize() {
    [this.width, this.height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    this.redraw();
  }

  /** Draw `data`; nothing is done where the same parts were drawn last. */
  show(data) {
    const before = this.shown ?? {};
    this.shown = data;
    if (!this.isDrawn || Object.keys(data).some((key) => data[key] !== before[key])) this.redraw();
  }

  redraw() {
    const { canvas, context } = this;
    const ratio = window.devicePixelRatio || 1;
    if (!this.shown || !this.width || !this.height) return;
    const [wide, high] = [this.width, this.height].map((px) => Math.round(px * ratio));
    // To be given a size, even the one that it has, costs a canvas all of its memory anew.
    if (canvas.width !== wide || canvas.height !== high) Object.assign(canvas, { width: wide, height: high });
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.isDrawn = false;
    this.draw(this, this.shown);
    this.isDrawn = true;
  }

  write(text, x, y, { colour = "gridtext", size = 11, weight = 400, align = "center" } = {}) {
    const { context } = this;
    context.save();
    context.font = `${weight} ${size}px ${this.font}`;
    context.textAlign = align;
    context.textBaseline = "middle";
    context.lineJoin = "round";
    context.lineWidth = 3.5;
    context.strokeStyle = this.colour.plan; // a rim, for what is written over a picture
    context.strokeText(text, x, y);
    context.fillStyle = this.colour[colour];
    context.fillText(text, x, y);
    context.restore();
  }
}
