// The map under the plan view: a PMTiles file of the user, drawn by MapLibre. Neither is loaded
// unless the settings name such a file; then the plan's own background becomes transparent.

import { authorised } from "./token.js";

const EARTH_ROUND_M = 40075016.686;
const TILE_PX = 512; // size of the world at zoom 0 in MapLibre
const M_PER_DEG = EARTH_ROUND_M / 360;
const SHADE = { raster: 0.55, fill: 0.35, line: 0.5 };

/** Whether the service has a map; earlier versions have none. */
async function named() {
  const answer = await authorised("v1/map");
  return answer.ok && (await answer.json()).name !== null;
}

export class Ground {
  constructor(holder, colourOf) {
    Object.assign(this, { holder, colourOf, map: null, place: null });
  }

  /** Load MapLibre and the file, if there is one; resolves to whether there is. */
  async begin() {
    if (!(await named())) return false;
    const [maplibre] = await Promise.all([
      import("./vendor/maplibre-gl.mjs"), script("vendor/pmtiles.js"),
      sheet("vendor/maplibre-gl.css"),
    ]);
    const archive = new globalThis.pmtiles.PMTiles(RANGES);
    const protocol = new globalThis.pmtiles.Protocol();
    protocol.add(archive);
    maplibre.addProtocol("pmtiles", protocol.tile);
    maplibre.setWorkerUrl(new URL("vendor/maplibre-gl-worker.mjs", document.baseURI).href);
    const [header, said] = await Promise.all([archive.getHeader(), archive.getMetadata()]);
    this.style = () => styleOf(header, said ?? {}, this.colourOf());
    this.map = new maplibre.Map({
      container: this.holder, style: this.style(), interactive: false, fadeDuration: 0,
      attributionControl: false, // the page's policy blocks the image of its button
    });
    this.holder.dataset.credit = plainOf(said?.attribution ?? "");
    return true;
  }

  recolour() {
    this.map?.setStyle(this.style());
  }

  /** Move the map so that the carrier is where the plan shows it; `view` is the plan, north up. */
  follow(view) {
    if (!this.map || !this.place) return;
    const camera = cameraOf(this.place, view);
    const key = JSON.stringify(camera);
    if (key === this.shown) return;
    this.shown = key;
    this.map.jumpTo(camera);
  }
}

/** MapLibre's camera for the plan's centre and scale: longitude, latitude, zoom. */
export function cameraOf(place, view) {
  const round = Math.cos(place.lat_deg * Math.PI / 180);
  const eastM = (view.width / 2 - view.centre[0]) / view.pxPerM;
  const northM = (view.centre[1] - view.height / 2) / view.pxPerM;
  const lat = place.lat_deg + northM / M_PER_DEG;
  const lon = place.lon_deg + eastM / M_PER_DEG / round;
  return { center: [lon, lat], zoom: Math.log2(view.pxPerM * EARTH_ROUND_M * round / TILE_PX) };
}

/** The file, read in ranges with the tab's token. */
const RANGES = {
  getKey: () => "area",
  async getBytes(offset, length, signal) {
    const headers = { Range: `bytes=${offset}-${offset + length - 1}` };
    const answer = await authorised("v1/map/tiles", { headers, signal });
    if (!answer.ok) throw new Error(`the map's tiles: ${answer.status}`);
    return { data: await answer.arrayBuffer() };
  },
};

/** A style without labels: raster tiles, or plain shapes of all vector layers. */
export function styleOf(header, said, colour) {
  const area = {
    type: header.tileType === 1 ? "vector" : "raster", tiles: ["pmtiles://area/{z}/{x}/{y}"],
    minzoom: header.minZoom, maxzoom: header.maxZoom,
    bounds: [header.minLon, header.minLat, header.maxLon, header.maxLat],
  };
  const ground = { id: "ground", type: "background", paint: { "background-color": colour.plan } };
  const layers = area.type === "raster"
    ? [{ id: "area", type: "raster", source: "area", paint: { "raster-opacity": SHADE.raster } }]
    : (said.vector_layers ?? []).flatMap(({ id }) => shapesOf(id, colour));
  if (area.type === "raster") area.tileSize = 256;
  return { version: 8, sources: { area }, layers: [ground, ...layers] };
}

function shapesOf(id, colour) {
  const common = { source: "area", "source-layer": id };
  const wet = /water|ocean|river|sea/.test(id);
  const tint = wet ? colour.beam : colour.gridtext;
  return [
    { ...common, id: `${id}-fill`, type: "fill", filter: ["==", ["geometry-type"], "Polygon"],
      paint: { "fill-color": tint, "fill-opacity": SHADE.fill * (wet ? 1 : 0.5) } },
    { ...common, id: `${id}-line`, type: "line", filter: ["!=", ["geometry-type"], "Point"],
      paint: { "line-color": tint, "line-opacity": SHADE.line } },
  ];
}

/** Text without markup, as attributions contain links. */
const plainOf = (html) => new DOMParser().parseFromString(html, "text/html").body.textContent;

function script(src) {
  return new Promise((resolve, reject) => {
    const made = Object.assign(document.createElement("script"), { src });
    made.onload = resolve;
    made.onerror = () => reject(new Error(`${src} could not be loaded`));
    document.head.append(made);
  });
}

function sheet(href) {
  document.head.append(Object.assign(document.createElement("link"), { rel: "stylesheet", href }));
}
