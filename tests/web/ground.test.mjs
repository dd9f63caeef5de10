// Camera of the map, so that it lies under the plan, and its style.

import assert from "node:assert/strict";
import { test } from "node:test";

import { cameraOf, styleOf } from "../../web/ground.js";

const PLACE = { lat_deg: 47.4, lon_deg: 8.5 };
const COLOUR = { plan: "#000", beam: "#00f", gridtext: "#888" };
const HEADER = { tileType: 1, minZoom: 3, maxZoom: 14, minLon: 8, minLat: 47, maxLon: 9, maxLat: 48 };

/** Pixel of a position in web Mercator with this camera, computed as MapLibre does. */
function pixelOf({ lat_deg: lat, lon_deg: lon }, camera, view) {
  const world = 512 * 2 ** camera.zoom;
  const at = (lonDeg, latDeg) => [
    (lonDeg + 180) / 360 * world,
    (1 - Math.asinh(Math.tan(latDeg * Math.PI / 180)) / Math.PI) / 2 * world,
  ];
  const [x, y] = at(lon, lat);
  const [x0, y0] = at(...camera.center);
  return [view.width / 2 + x - x0, view.height / 2 + y - y0];
}

for (const centre of [[400, 300], [120, 555], [790, 20]]) {
  test(`the map has the carrier under its symbol at ${centre}`, () => {
    const view = { width: 800, height: 600, centre, pxPerM: 0.7 };
    const camera = cameraOf(PLACE, view);
    const [x, y] = pixelOf(PLACE, camera, view);
    assert.ok(Math.hypot(x - centre[0], y - centre[1]) < 0.5, `${x} ${y}`);
    // A hundred metres north are seventy pixels up.
    const north = { ...PLACE, lat_deg: PLACE.lat_deg + 100 / (40075016.686 / 360) };
    const [, higher] = pixelOf(north, camera, view);
    assert.ok(Math.abs(y - higher - 70) < 0.5, `${y - higher}`);
  });
}

test("raster tiles are shown unchanged, vector tiles without text, nothing external", () => {
  const layers = [{ id: "water" }, { id: "roads" }];
  const vector = styleOf(HEADER, { vector_layers: layers }, COLOUR);
  assert.equal(vector.sources.area.type, "vector");
  assert.deepEqual(vector.layers.map(({ type }) => type),
    ["background", "fill", "line", "fill", "line"]);
  assert.equal(vector.layers[1].paint["fill-color"], COLOUR.beam);
  const raster = styleOf({ ...HEADER, tileType: 2 }, {}, COLOUR);
  assert.deepEqual(raster.layers.map(({ type }) => type), ["background", "raster"]);
  for (const style of [vector, raster]) {
    assert.equal("glyphs" in style || "sprite" in style, false);
    assert.ok(!JSON.stringify(style).includes("http"));
  }
});
