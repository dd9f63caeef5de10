// A 2D context that draws nothing and remembers everything: each stroke, fill and text with the
// path as it lies on the picture (every transform applied) and the pen as it was. As strict as a
// real one: a negative radius or a gradient's stop outside 0 … 1 is an error; and stricter, for
// a coordinate that is no number, which a real one drops without a word.

const PEN = {
  fillStyle: "#000000", strokeStyle: "#000000", lineWidth: 1, globalAlpha: 1, lineCap: "butt",
  lineJoin: "miter", font: "10px sans-serif", textAlign: "start", textBaseline: "alphabetic",
};

function finite(...values) {
  for (const value of values) {
    if (!Number.isFinite(value)) throw new TypeError(`drawn at ${values.join(", ")}`);
  }
}

function positive(...radii) {
  if (radii.some((radius) => radius < 0)) throw new RangeError(`a radius of ${radii.join(", ")}`);
}

export class RecordingContext {
  constructor() {
    Object.assign(this, PEN, { dash: [], matrix: [1, 0, 0, 1, 0, 0], saved: [] });
    this.path = [];
    this.drawn = []; // visible items, oldest first
  }

  // --- the pen and the sheet --------------------------------------------------------------------

  save() {
    const pen = Object.fromEntries(Object.keys(PEN).map((name) => [name, this[name]]));
    this.saved.push({ ...pen, dash: this.dash, matrix: this.matrix });
  }

  restore() {
    Object.assign(this, this.saved.pop()); // the path is not part of the saved state
  }

  setLineDash(dash) {
    this.dash = [...dash];
  }

  setTransform(...matrix) {
    finite(...matrix);
    this.matrix = matrix;
  }

  transform(a, b, c, d, e, f) {
    finite(a, b, c, d, e, f);
    const [A, B, C, D, E, F] = this.matrix;
    this.matrix = [A * a + C * b, B * a + D * b, A * c + C * d, B * c + D * d,
      A * e + C * f + E, B * e + D * f + F];
  }

  translate(x, y) {
    this.transform(1, 0, 0, 1, x, y);
  }

  rotate(angle) {
    this.transform(Math.cos(angle), Math.sin(angle), -Math.sin(angle), Math.cos(angle), 0, 0);
  }

  onSheet(x, y) {
    finite(x, y);
    const [a, b, c, d, e, f] = this.matrix;
    return { x: a * x + c * y + e, y: b * x + d * y + f };
  }

  // --- paths ------------------------------------------------------------------------------------

  beginPath() {
    this.path = [];
  }

  closePath() {
    this.path.push({ op: "close" });
  }

  moveTo(x, y) {
    this.path.push({ op: "move", ...this.onSheet(x, y) });
  }

  lineTo(x, y) {
    this.path.push({ op: "line", ...this.onSheet(x, y) });
  }

  bezierCurveTo(x1, y1, x2, y2, x, y) {
    const controls = [this.onSheet(x1, y1), this.onSheet(x2, y2)];
    this.path.push({ op: "curve", controls, ...this.onSheet(x, y) });
  }

  arc(x, y, radius, from, to) {
    this.ellipse(x, y, radius, radius, 0, from, to);
    this.path.at(-1).op = "arc";
  }

  /** Kept with half its width and height on the picture: `halfX`, `halfY` of the whole ellipse. */
  ellipse(x, y, radiusX, radiusY, rotation, from, to) {
    finite(radiusX, radiusY, rotation, from, to);
    positive(radiusX, radiusY);
    const [a, b, c, d] = this.matrix;
    const [cos, sin] = [Math.cos(rotation), Math.sin(rotation)];
    const [ux, uy] = [(a * cos + c * sin) * radiusX, (b * cos + d * sin) * radiusX];
    const [vx, vy] = [(c * cos - a * sin) * radiusY, (d * cos - b * sin) * radiusY];
    this.path.push({
      op: "ellipse", ...this.onSheet(x, y), halfX: Math.hypot(ux, vx), halfY: Math.hypot(uy, vy),
      from, to,
    });
  }

  // --- what can be seen -------------------------------------------------------------------------

  keep(kind, what) {
    const pen = Object.fromEntries(Object.keys(PEN).map((name) => [name, this[name]]));
    this.drawn.push({ kind, ...pen, dash: this.dash, scale: this.matrix[0], ...what });
  }

  stroke() {
    this.keep("stroke", { path: [...this.path] });
  }

  fill() {
    this.keep("fill", { path: [...this.path] });
  }

  fillRect(x, y, width, height) {
    finite(width, height);
    const [left, right] = [this.onSheet(x, y), this.onSheet(x + width, y + height)];
    this.keep("rect", { ...left, width: right.x - left.x, height: right.y - left.y });
  }

  fillText(text, x, y) {
    this.keep("text", { text, ...this.onSheet(x, y) });
  }

  strokeText(text, x, y) {
    this.keep("rim", { text, ...this.onSheet(x, y) });
  }

  /** Every letter is half as wide as it is high. */
  measureText(text) {
    return { width: (text.length * Number(/([\d.]+)px/.exec(this.font)[1])) / 2 };
  }

  createRadialGradient(x0, y0, r0, x1, y1, r1) {
    finite(x0, y0, r0, x1, y1, r1);
    positive(r0, r1);
    const stops = [];
    const addColorStop = (offset, colour) => {
      if (!(offset >= 0 && offset <= 1)) throw new RangeError(`a colour's stop at ${offset}`);
      stops.push([offset, colour]);
    };
    return { stops, radius: r1, addColorStop };
  }

  // --- questions --------------------------------------------------------------------------------

  forget() {
    this.drawn = [];
  }

  of(kind, wanted = () => true) {
    return this.drawn.filter((one) => one.kind === kind && wanted(one));
  }

  /** Position of a text; an error if it is missing or repeated. */
  text(text) {
    const found = this.of("text", (one) => one.text === text);
    if (found.length !== 1) throw new Error(`${found.length} times "${text}" among ${this.texts}`);
    return found[0];
  }

  get texts() {
    return this.of("text").map((one) => one.text);
  }
}
