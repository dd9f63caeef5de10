// A canvas that adapts to its size, the pixel ratio and the theme's colours.

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
    this.isDrawn = false; // whether the last drawing succeeded
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.recolour();
  }

  recolour() {
    this.colour = readColours(this.colourNames);
    this.font = fontOf();
    this.redraw();
  }

  /** The size is read only here: during a refresh, reading it would cost a layout. */
  resize() {
    [this.width, this.height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    this.redraw();
  }

  /** Draw `data`, unless it is unchanged. */
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
    // Setting a canvas's size, even to the same value, reallocates its memory.
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
    context.strokeStyle = this.colour.plan; // an outline, for text over a picture
    context.strokeText(text, x, y);
    context.fillStyle = this.colour[colour];
    context.fillText(text, x, y);
    context.restore();
  }
}
