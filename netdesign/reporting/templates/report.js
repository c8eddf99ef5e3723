"use strict";
(() => {
const data = JSON.parse(document.getElementById("data").textContent);
const networks = data.networks, byId = new Map(networks.map((network, index) => [network.id, index]));
const $ = (selector, root = document) => root.querySelector(selector);
const $$ = (selector, root = document) => [...root.querySelectorAll(selector)];
const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const config = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["autoScale2d", "toggleSpikelines", "sendChartToCloud", "zoomIn2d", "zoomOut2d", "resetCameraLastSave3d", "orbitRotation"] };
const webgl = (() => { try { return !!document.createElement("canvas").getContext("webgl"); } catch { return false; } })();
if (!webgl) document.documentElement.classList.add("nogl");
let selected = data.knee, brushed = null, stopTour = () => {};

/* ------------------------------------------------------------------ layout that follows the theme */
function layout(extra) {
  const axis = { gridcolor: css("--plot-grid"), linecolor: css("--faint"), zeroline: false, ticks: "outside", ticklen: 4, tickcolor: css("--line"), automargin: true };
  const base = {
    font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: css("--muted") },
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", margin: { l: 52, r: 14, t: 12, b: 44 },
    showlegend: false, hovermode: "closest", dragmode: "select", modebar: { bgcolor: "rgba(0,0,0,0)", color: css("--faint"), activecolor: css("--accent") }, hoverlabel: { font: { family: getComputedStyle(document.body).fontFamily } },
    xaxis: { ...axis, ...(extra.x || {}) }, yaxis: { ...axis, ...(extra.y || {}) },
  };
  return { ...base, ...(extra.layout || {}) };
}
const names = { sigma: `${data.sigmaName} [µm]`, tour: `tour [${data.tourUnit}]`, images: "images" };
/* Okabe-Ito and viridis are made for paper: on a dark page the dark end is lifted. */
const tint = color => {
  if (document.documentElement.dataset.theme !== "dark") return color;
  return "#" + [1, 3, 5].map(at => Math.round(.72 * parseInt(color.slice(at, at + 2), 16) + .28 * 255).toString(16).padStart(2, "0")).join("");
};
const fixed = (value, digits = 2) => value === null || value === undefined ? "–" : Number(value).toFixed(digits);
const words = network => `<b>Network ${String(network.id).padStart(4, "0")}</b><br>${network.images} images<br>${data.sigmaName} ${fixed(network.sigma)} µm<br>tour ${fixed(network.tour)} ${data.tourUnit}<br>${network.verdict}`;

/* ------------------------------------------------------------------ the front */
function layers(x, y, z) {
  const sizes = [...new Set(networks.map(network => network.images))];
  return sizes.map(size => {
    const rows = networks.filter(network => network.images === size).sort((a, b) => a.tour - b.tour);
    const line = { x: rows.map(row => row[x]), y: rows.map(row => row[y]), mode: "lines", hoverinfo: "skip", line: { color: tint(rows[0].color), width: z ? 3 : 1.5 }, opacity: .75 };
    return z ? { ...line, type: "scatter3d", z: rows.map(row => row[z]) } : { ...line, type: "scatter" };
  });
}
function dots(x, y, z) {
  const trace = {
    x: networks.map(network => network[x]), y: networks.map(network => network[y]), mode: "markers", name: "networks", text: networks.map(words),
    customdata: networks.map(network => network.id), hovertemplate: "%{text}<extra></extra>", marker: { color: networks.map(network => tint(network.color)), size: z ? 5 : 9, line: { width: z ? 0 : 1, color: css("--card") } },
  };
  return z ? { ...trace, type: "scatter3d", z: networks.map(network => network[z]) }
    : { ...trace, type: "scatter", selectedpoints: brushed, selected: { marker: { opacity: 1 } }, unselected: { marker: { opacity: .16 } } };
}
function ring(x, y, z) {
  const network = networks[byId.get(selected)];
  const trace = { x: [network[x]], y: [network[y]], mode: "markers", hoverinfo: "skip", marker: { color: "rgba(0,0,0,0)", size: z ? 10 : 17, symbol: z ? "circle-open" : "circle", line: { color: css("--achieved"), width: 2 } } };
  if (z) trace.marker.color = css("--achieved");
  return z ? { ...trace, type: "scatter3d", z: [network[z]] } : { ...trace, type: "scatter" };
}
const flat = { "plot-motion": ["tour", "sigma"], "plot-images": ["images", "sigma"], "plot-travel": ["images", "tour"] };
function drawFront() {
  for (const [id, [x, y]] of Object.entries(flat)) {
    const traces = id === "plot-motion" ? layers(x, y) : [];
    if (id === "plot-images" && data.bounds.length)
      traces.push({ x: data.bounds.map(row => row[0]), y: data.bounds.map(row => row[1]), mode: "lines+markers", name: "lower bound", line: { color: css("--faint"), dash: "dash", width: 1.4 }, marker: { symbol: "line-ew", size: 8, line: { width: 1.4, color: css("--faint") } }, hovertemplate: "no network of %{x} images can go below %{y:.2f} µm<extra></extra>" });
    const sizes = new Set(networks.map(network => network.images)).size;
    const integer = x === "images" ? { dtick: sizes > 14 ? 2 : 1, tickformat: "d" } : {};
    const low = { rangemode: id === "plot-images" && data.bounds.length ? "tozero" : "normal" };
    Plotly.react(id, [...traces, ring(x, y), dots(x, y)], layout({ x: { title: { text: names[x], standoff: 8 }, ...integer }, y: { title: { text: names[y], standoff: 8 }, ...low } }), config);
  }
  if (webgl) {
    const scene = { xaxis: axis3(names.tour), yaxis: axis3(names.images), zaxis: axis3(names.sigma), camera: $("#plot-cloud").layout?.scene?.camera || { eye: { x: -1.45, y: -1.55, z: .75 }, center: { x: 0, y: 0, z: -.12 } }, aspectmode: "cube" };
    Plotly.react("plot-cloud", [...layers("tour", "images", "sigma"), dots("tour", "images", "sigma"), ring("tour", "images", "sigma")], layout({ layout: { scene, margin: { l: 0, r: 0, t: 0, b: 0 } } }), config);
  }
}
const axis3 = text => ({ title: { text, font: { size: 12 } }, gridcolor: css("--plot-grid"), color: css("--muted"), showbackground: false, zeroline: false, tickfont: { size: 10 } });

function listenFront() {
  for (const id of [...Object.keys(flat), ...(webgl ? ["plot-cloud"] : [])]) {
    const plot = document.getElementById(id);
    plot.on("plotly_click", event => { const hit = event.points.find(point => point.customdata !== undefined); if (hit) select(hit.customdata); });
    if (id === "plot-cloud") continue;
    plot.on("plotly_selected", event => {
      const ids = event ? event.points.filter(point => point.customdata !== undefined).map(point => point.customdata) : [];
      brush(ids.length ? ids : null);
    });
    plot.on("plotly_deselect", () => brush(null));
  }
}
function brush(ids) {
  brushed = ids && ids.map(id => byId.get(id));
  for (const id of Object.keys(flat)) {
    const plot = document.getElementById(id);
    Plotly.restyle(plot, { selectedpoints: [brushed] }, [plot.data.length - 1]);
    if (!ids && plot.layout.selections && plot.layout.selections.length) Plotly.relayout(plot, { selections: [] });
  }
  const kept = new Set(ids || []);
  for (const row of $$("#table tbody tr")) row.classList.toggle("dim", !!ids && !kept.has(Number(row.dataset.id)));
  drawAchieved();
}

/* ------------------------------------------------------------------ achieved against predicted */
function drawAchieved() {
  const plot = document.getElementById("plot-achieved");
  if (!plot) return;
  const proved = networks.filter(network => network.proof);
  if (!proved.length) return;
  const values = proved.flatMap(network => [network.proof.predicted, network.proof.achieved]).filter(value => value > 0);
  const low = Math.min(...values) / 1.15, high = Math.max(...values) * 1.15, log = high / low > 4;
  const band = { x: [low, high, high, low], y: [low * .9, high * .9, high * 1.1, low * 1.1], fill: "toself", mode: "none", fillcolor: css("--band"), opacity: .6, hoverinfo: "skip" };
  const one = { x: [low, high], y: [low, high], mode: "lines", line: { color: css("--faint"), dash: "dash", width: 1.2 }, hoverinfo: "skip" };
  const trace = { x: proved.map(network => network.proof.predicted), y: proved.map(network => network.proof.achieved), mode: "markers", customdata: proved.map(network => network.id),
    text: proved.map(network => `${words(network)}<br>predicted ${fixed(network.proof.predicted)} µm, achieved ${fixed(network.proof.achieved)} µm`), hovertemplate: "%{text}<extra></extra>",
    marker: { size: proved.map(network => network.id === selected ? 13 : 9), color: proved.map(network => tint(network.color)), symbol: proved.map(network => network.proof.pass ? "circle" : "x"), line: { width: proved.map(network => network.id === selected ? 2 : 1), color: proved.map(network => network.id === selected ? css("--achieved") : css("--card")) } },
    selectedpoints: brushed && proved.map((network, index) => brushed.includes(byId.get(network.id)) ? index : -1).filter(index => index >= 0), unselected: { marker: { opacity: .16 } } };
  const axis = { type: log ? "log" : "linear", range: (log ? [Math.log10(low), Math.log10(high)] : [low, high]) };
  Plotly.react(plot, [band, one, trace], layout({ x: { title: { text: "predicted rms sigma [µm]", standoff: 8 }, ...axis }, y: { title: { text: "achieved rms error [µm]", standoff: 8 }, ...axis }, layout: { dragmode: "pan" } }), config);
}

/* ------------------------------------------------------------------ table */
function sortTable(table, header) {
  const column = [...header.parentNode.children].indexOf(header), body = table.tBodies[0];
  const down = header.getAttribute("aria-sort") === "ascending";
  $$("th", table).forEach(cell => cell.removeAttribute("aria-sort"));
  header.setAttribute("aria-sort", down ? "descending" : "ascending");
  const key = row => { const raw = row.cells[column].dataset.value ?? row.cells[column].textContent; const number = Number(raw); return raw === "" ? Infinity : Number.isNaN(number) ? raw : number; };
  const rows = [...body.rows].map((row, index) => [key(row), index, row]);
  rows.sort((a, b) => (a[0] < b[0] ? -1 : a[0] > b[0] ? 1 : 0) * (down ? -1 : 1) || a[1] - b[1]);
  body.append(...rows.map(row => row[2]));
}
function listenTable() {
  const table = document.getElementById("table");
  table.addEventListener("click", event => {
    const header = event.target.closest("th"), row = event.target.closest("tbody tr");
    if (header) sortTable(table, header); else if (row) select(Number(row.dataset.id));
  });
  table.addEventListener("keydown", event => { if (event.key === "Enter" && event.target.matches("tbody tr")) select(Number(event.target.dataset.id)); });
}

/* ------------------------------------------------------------------ one network */
function select(id, scroll = true) {
  selected = id;
  stopTour();
  for (const article of $$("article.network")) article.classList.toggle("shown", Number(article.dataset.id) === id);
  for (const row of $$("#table tbody tr")) row.classList.toggle("selected", Number(row.dataset.id) === id);
  drawFront(); drawAchieved(); showScene();
  if (scroll) { history.replaceState(null, "", `#network-${String(id).padStart(4, "0")}`); $("#detail").scrollIntoView({ block: "start" }); }
}
const triples = (list, index) => [list[3 * index], list[3 * index + 1], list[3 * index + 2]];
const column = (list, axis) => { const out = []; for (let k = axis; k < list.length; k += 3) out.push(list[k]); return out; };
function partTraces() {
  const { v, f, e } = data.part, x = [], y = [], z = [];
  for (let k = 0; k < e.length; k += 2) for (const end of [e[k], e[k + 1], null]) { const point = end === null ? [null, null, null] : triples(v, end); x.push(point[0]); y.push(point[1]); z.push(point[2]); }
  return [
    { type: "mesh3d", x: column(v, 0), y: column(v, 1), z: column(v, 2), i: column(f, 0), j: column(f, 1), k: column(f, 2), color: css("--part"), flatshading: true, hoverinfo: "skip", lighting: { ambient: .72, diffuse: .45, specular: .03, roughness: .9 }, lightposition: { x: 1e4, y: -2e4, z: 4e4 } },
    { type: "scatter3d", mode: "lines", x, y, z, line: { color: css("--part-edge"), width: 1.6 }, hoverinfo: "skip" },
  ];
}
function tagMesh(color, extra = {}) {
  const points = data.tags, i = [], j = [], k = [];
  for (let tag = 0; tag < points.length / 12; tag++) { i.push(4 * tag, 4 * tag); j.push(4 * tag + 1, 4 * tag + 2); k.push(4 * tag + 2, 4 * tag + 3); }
  return { type: "mesh3d", x: column(points, 0), y: column(points, 1), z: column(points, 2), i, j, k, facecolor: color, hoverinfo: "skip", lighting: { ambient: 1, diffuse: 0, specular: 0 }, ...extra };
}
const rotate = (network, image, ray) => [0, 1, 2].map(row => ray.reduce((sum, value, axis) => sum + network.rotations[9 * image + 3 * row + axis] * value, 0));
function frusta(network, images, depth) {
  const x = [], y = [], z = [], put = point => { x.push(point ? point[0] : null); y.push(point ? point[1] : null); z.push(point ? point[2] : null); };
  for (const image of images) {
    const apex = triples(network.centres, image);
    const base = [0, 1, 2, 3].map(corner => rotate(network, image, [data.frustum[2 * corner] * depth, data.frustum[2 * corner + 1] * depth, depth]).map((value, axis) => value + apex[axis]));
    for (let corner = 0; corner < 4; corner++) { put(apex); put(base[corner]); put(base[(corner + 1) % 4]); put(null); }
  }
  return { x, y, z };
}
const sceneLayout = (camera, reach) => {
  const hidden = { visible: false, showspikes: false, range: reach && [-reach, reach] };
  return layout({ layout: { margin: { l: 0, r: 0, t: 0, b: 0 }, scene: { xaxis: hidden, yaxis: { ...hidden }, zaxis: { ...hidden }, aspectmode: "data", camera }, dragmode: "turntable" } });
};
const eye = { eye: { x: .8, y: -1.2, z: .72 }, center: { x: 0, y: 0, z: -.05 } };

function showScene() {
  if (!webgl) return;
  const network = networks[byId.get(selected)], article = document.getElementById(`network-${String(selected).padStart(4, "0")}`), slot = $(".slot", article);
  let scene = $(".scene-box");
  if (!scene) {
    scene = document.createElement("div"); scene.className = "scene-box";
    scene.append(document.getElementById("scene-template").content.cloneNode(true));
  }
  slot.append(scene);
  const part = role => $(`[data-role="${role}"]`, scene);
  const count = network.images, everyone = [...Array(count).keys()];
  let propagation = $('[data-role="propagation"] [aria-pressed="true"]', scene).dataset.value, factor = network.factor, current = 0;

  /* stations and tour */
  const accent = css("--accent"), depth = .16 * data.radius;
  const draw = () => {
    const seen = new Set(network.seen[current]);
    const tags = []; for (let tag = 0; tag < data.points.length / 12; tag++) { const color = seen.has(tag) ? css("--total") : css("--part-edge"); tags.push(color, color); }
    const here = frusta(network, [current], data.radius), line = { x: column(network.centres, 0), y: column(network.centres, 1), z: column(network.centres, 2) };
    const travelled = axis => line[axis].slice(0, current + 1);
    const traces = [
      ...partTraces(), tagMesh(tags),
      { type: "scatter3d", mode: "lines", ...frusta(network, everyone, depth), line: { color: accent, width: 2 }, opacity: .8, hoverinfo: "skip" },
      { type: "scatter3d", mode: "lines", ...here, line: { color: css("--achieved"), width: 1.6 }, opacity: .55, hoverinfo: "skip" },
      { type: "scatter3d", mode: "lines", ...line, line: { color: css("--faint"), width: 3 }, hoverinfo: "skip" },
      { type: "scatter3d", mode: "lines", x: travelled("x"), y: travelled("y"), z: travelled("z"), line: { color: css("--achieved"), width: 6 }, hoverinfo: "skip" },
      { type: "scatter3d", mode: "markers+text", ...line, text: everyone.map(image => String(image + 1)), textposition: "top center", textfont: { size: 12, color: css("--ink") }, hovertemplate: "station %{text}<extra></extra>", marker: { size: everyone.map(image => image === current ? 7 : 4), color: everyone.map(image => image === current ? css("--achieved") : accent) } },
    ];
    const plot = part("stations");
    Plotly.react(plot, traces, sceneLayout(plot.layout?.scene?.camera || eye), config);
    part("where").textContent = `station ${current + 1} of ${count}, sees ${network.seen[current].length} tags`;
  };
  const robot = data.arm && network.joints, fine = robot ? .05 : 1, cell = robot && robotCell(network, part("cell"));
  part("cell-figure").hidden = !robot;
  part("step").max = count; part("step").step = fine;
  let position = 0;
  const go = to => {
    position = Math.min(to, count - 1);
    const station = Math.round(position);
    if (station !== current) { current = station; draw(); }
    part("step").value = position + 1;
    if (cell) cell(position);
  };
  part("step").oninput = event => { stopTour(); go(Number(event.target.value) - 1); };
  part("play").onclick = () => {
    if (part("play").dataset.running) return stopTour();
    part("play").dataset.running = "yes"; part("play").textContent = "❚❚ Tour";
    if (position >= count - 1) go(0);
    const timer = setInterval(() => { if (position >= count - 1) return stopTour(); go(robot ? position + .1 : position + 1); }, robot ? 90 : 700);
    stopTour = () => { clearInterval(timer); delete part("play").dataset.running; part("play").textContent = "▶ Tour"; stopTour = () => {}; };
  };

  /* ellipsoids */
  const steps = [...new Set([1, 10, 50, 100, 200, 500, 1000, 2000, 5000, 10000, network.factor])].sort((a, b) => a - b);
  part("factor").replaceChildren(...steps.map(step => new Option(step.toLocaleString("en"), step, false, step === factor)));
  const uncertainty = () => {
    const sigma = maxSigma(network[propagation]), known = sigma.filter(Number.isFinite), low = Math.min(...known), high = Math.max(...known);
    const shape = ellipsoids(network[propagation], factor, sigma), plot = part("ellipsoids");
    const traces = [...partTraces(), tagMesh(Array(data.points.length / 6).fill(css("--part-edge")), { opacity: .35 }),
      { type: "mesh3d", ...shape, intensitymode: "vertex", colorscale: "Cividis", cmin: low, cmax: high, colorbar: { thickness: 10, len: .6, outlinewidth: 0, title: { text: "σ max<br>[µm]", font: { size: 11 } }, tickfont: { size: 10 } }, hoverinfo: "skip", lighting: { ambient: .7, diffuse: .5, specular: .1 } },
      { type: "scatter3d", mode: "markers", x: column(data.points, 0), y: column(data.points, 1), z: column(data.points, 2), marker: { size: 6, opacity: 0 }, text: data.pointIds.map((id, index) => `point ${id}<br>largest sigma ${fixed(sigma[index])} µm<br>${network.rays[index]} rays`), hovertemplate: "%{text}<extra></extra>" }];
    if (network.error) traces.push(errorTrace(network, factor));
    Plotly.react(plot, traces, sceneLayout(plot.layout?.scene?.camera || { eye: { x: 1.0, y: -1.5, z: .95 } }), config);
    part("caption").textContent = `One-sigma ellipsoids of the object points, drawn ${factor.toLocaleString("en")} times too large, ${propagation === "limited" ? "limited error propagation (poses error-free)" : "total error propagation, datum: inner constraints over all object points"}` + (network.error ? "; orange lines: the error that was really made, as large." : ".");
  };
  part("factor").onchange = event => { factor = Number(event.target.value); uncertainty(); };
  for (const button of $$('[data-role="propagation"] button', scene)) button.onclick = () => {
    propagation = button.dataset.value;
    for (const other of $$('[data-role="propagation"] button', scene)) other.setAttribute("aria-pressed", String(other === button));
    uncertainty();
  };
  draw(); uncertainty(); if (cell) cell(0);
}

/* ------------------------------------------------------------------ the robot: forward kinematics of a chain that turns about z */
const times = (a, b) => { const out = new Array(12); for (let r = 0; r < 3; r++) for (let c = 0; c < 4; c++) out[4 * r + c] = a[4 * r] * b[c] + a[4 * r + 1] * b[4 + c] + a[4 * r + 2] * b[8 + c] + (c === 3 ? a[4 * r + 3] : 0); return out; };
const turn = q => [Math.cos(q), -Math.sin(q), 0, 0, Math.sin(q), Math.cos(q), 0, 0, 0, 0, 1, 0];
const carry = (m, x, y, z) => [m[0] * x + m[1] * y + m[2] * z + m[3], m[4] * x + m[5] * y + m[6] * z + m[7], m[8] * x + m[9] * y + m[10] * z + m[11]];
function linkPoses(joints) {
  const poses = [data.arm.base];
  joints.forEach((q, index) => poses.push(times(times(poses[index], data.arm.placements.slice(12 * index, 12 * index + 12)), turn(q))));
  return poses;
}
function armMesh(poses) {
  const x = [], y = [], z = [];
  for (const mesh of data.arm.links) for (let k = 0; k < mesh.v.length; k += 3) { const p = carry(poses[mesh.link], mesh.v[k], mesh.v[k + 1], mesh.v[k + 2]); x.push(p[0]); y.push(p[1]); z.push(p[2]); }
  return { x, y, z };
}
function boxes() {
  const x = [], y = [], z = [], i = [], j = [], k = [], quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
  for (const box of data.arm.obstacles) {
    const start = x.length;
    for (const sx of [-.5, .5]) for (const sy of [-.5, .5]) for (const sz of [-.5, .5]) { x.push(box[0] + sx * box[3]); y.push(box[1] + sy * box[4]); z.push(box[2] + sz * box[5]); }
    for (const [a, b, c, d] of quads) { i.push(start + a, start + a); j.push(start + b, start + c); k.push(start + c, start + d); }
  }
  return { x, y, z, i, j, k };
}
/* Returns a function that puts the arm between two stations of the network. */
function robotCell(network, plot) {
  const count = data.arm.placements.length / 12, i = [], j = [], k = [];
  let start = 0;
  for (const mesh of data.arm.links) { for (let t = 0; t < mesh.f.length; t += 3) { i.push(start + mesh.f[t]); j.push(start + mesh.f[t + 1]); k.push(start + mesh.f[t + 2]); } start += mesh.v.length / 3; }
  const joint = station => network.joints.slice(count * station, count * (station + 1));
  /* Where the arm is on its way to the next station: straight in joint space from via point to via point, the share counted in joint distance. */
  const way = from => {
    const stops = [joint(from)], vias = network.vias[from] || [];
    for (let at = 0; at < vias.length; at += count) stops.push(vias.slice(at, at + count));
    return [...stops, joint(Math.min(from + 1, network.images - 1))];
  };
  const at = position => {
    const from = Math.floor(position), stops = way(from), gaps = stops.slice(1).map((stop, leg) => Math.hypot(...stop.map((q, axis) => q - stops[leg][axis])));
    let left = (position - from) * gaps.reduce((sum, gap) => sum + gap, 0), leg = 0;
    while (leg < gaps.length - 1 && left > gaps[leg]) left -= gaps[leg++];
    const share = gaps[leg] > 0 ? left / gaps[leg] : 0, a = stops[leg], b = stops[leg + 1];
    const poses = linkPoses(a.map((value, axis) => value + share * (b[axis] - value))), camera = times(poses[count], data.arm.camera);
    const seen = { x: [], y: [], z: [] }, put = p => { seen.x.push(p ? p[0] : null); seen.y.push(p ? p[1] : null); seen.z.push(p ? p[2] : null); }, depth = .9 * data.radius;
    const apex = carry(camera, 0, 0, 0), base = [0, 1, 2, 3].map(corner => carry(camera, data.frustum[2 * corner] * depth, data.frustum[2 * corner + 1] * depth, depth));
    for (let corner = 0; corner < 4; corner++) { put(apex); put(base[corner]); put(base[(corner + 1) % 4]); put(null); }
    return [armMesh(poses), seen];
  };
  const line = { x: column(network.centres, 0), y: column(network.centres, 1), z: column(network.centres, 2) };
  const [mesh, view] = at(0), dull = { ambient: .62, diffuse: .6, specular: .06, roughness: .8 };
  const traces = [
    { type: "mesh3d", ...mesh, i, j, k, color: css("--arm"), hoverinfo: "skip", lighting: dull },
    { type: "scatter3d", mode: "lines", ...view, line: { color: css("--achieved"), width: 2 }, hoverinfo: "skip" },
    ...partTraces(), tagMesh(Array(data.points.length / 6).fill(css("--part-edge"))),
    { type: "mesh3d", ...boxes(), color: css("--part"), flatshading: true, hoverinfo: "skip", lighting: dull },
    { type: "scatter3d", mode: "lines+markers", ...line, line: { color: css("--accent"), width: 3 }, marker: { size: 3, color: css("--accent") }, text: line.x.map((_, station) => `station ${station + 1}`), hovertemplate: "%{text}<extra></extra>" },
  ];
  Plotly.react(plot, traces, sceneLayout(plot.layout?.scene?.camera || { eye: { x: .62, y: -1.12, z: .4 }, center: { x: 0, y: 0, z: .04 } }), config);
  return position => { const [body, seen] = at(position); Plotly.restyle(plot, { x: [body.x, seen.x], y: [body.y, seen.y], z: [body.z, seen.z] }, [0, 1]); };
}

/* ------------------------------------------------------------------ ellipsoids: an icosahedron carried by the square root of the covariance */
const sphere = (() => {
  const g = (1 + Math.sqrt(5)) / 2, unit = p => { const n = Math.hypot(...p); return p.map(value => value / n); };
  const points = [[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g], [0, -1, -g], [0, 1, -g], [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]].map(unit);
  let faces = [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]];
  const middle = new Map(), between = (a, b) => { const key = a < b ? `${a},${b}` : `${b},${a}`; if (!middle.has(key)) { middle.set(key, points.length); points.push(unit(points[a].map((value, axis) => value + points[b][axis]))); } return middle.get(key); };
  faces = faces.flatMap(([a, b, c]) => { const d = between(a, b), e = between(b, c), f = between(c, a); return [[a, d, f], [d, b, e], [f, e, c], [d, e, f]]; });
  return { points, faces };
})();
const covarianceOf = (list, index) => { const c = list.slice(6 * index, 6 * index + 6); return c.some(value => value === null) ? null : c; };
/* Cholesky: any square root carries the unit sphere to the same ellipsoid. */
function root([xx, xy, xz, yy, yz, zz]) {
  const a = Math.sqrt(Math.max(xx, 1e-30)), b = xy / a, c = xz / a, d = Math.sqrt(Math.max(yy - b * b, 1e-30)), e = (yz - b * c) / d, f = Math.sqrt(Math.max(zz - c * c - e * e, 1e-30));
  return [[a, 0, 0], [b, d, 0], [c, e, f]];
}
function maxSigma(list) {
  const out = [];
  for (let index = 0; index < list.length / 6; index++) { const c = covarianceOf(list, index); out.push(c ? Math.sqrt(Math.max(c[0], c[3], c[5])) : Infinity); }
  return out;
}
function ellipsoids(list, factor, sigma) {
  const x = [], y = [], z = [], i = [], j = [], k = [], intensity = [], scale = factor * 1e-3;
  for (let index = 0; index < list.length / 6; index++) {
    const c = covarianceOf(list, index);
    if (!c) continue;
    const m = root(c), centre = triples(data.points, index), start = x.length;
    for (const p of sphere.points) { x.push(centre[0] + scale * (m[0][0] * p[0])); y.push(centre[1] + scale * (m[1][0] * p[0] + m[1][1] * p[1])); z.push(centre[2] + scale * (m[2][0] * p[0] + m[2][1] * p[1] + m[2][2] * p[2])); intensity.push(sigma[index]); }
    for (const face of sphere.faces) { i.push(start + face[0]); j.push(start + face[1]); k.push(start + face[2]); }
  }
  return { x, y, z, i, j, k, intensity };
}
function errorTrace(network, factor) {
  const x = [], y = [], z = [], put = (point, offset) => { x.push(point[0] + offset[0]); y.push(point[1] + offset[1]); z.push(point[2] + offset[2]); };
  for (let index = 0; index < network.error.length / 3; index++) {
    const error = triples(network.error, index);
    if (error.includes(null)) continue;
    put(triples(data.points, index), [0, 0, 0]); put(triples(data.points, index), error.map(value => value * factor * 1e-3)); x.push(null); y.push(null); z.push(null);
  }
  return { type: "scatter3d", mode: "lines", x, y, z, line: { color: css("--achieved"), width: 4 }, hoverinfo: "skip" };
}

/* ------------------------------------------------------------------ object points, made when they are asked for */
function pointTable(article) {
  const box = $("details.points .scroll", article), network = networks[byId.get(Number(article.dataset.id))];
  if (box.firstChild) return;
  const head = ["point", "x mm", "y mm", "z mm", "rays", "σx limited µm", "σy", "σz", "σx total µm", "σy", "σz"];
  if (network.error) head.push("error x µm", "y", "z");
  const sigma = (list, index) => [0, 3, 5].map(entry => list[6 * index + entry]).map(value => value === null ? "–" : Math.sqrt(value).toFixed(2));
  const rows = data.pointIds.map((id, index) => [id, ...triples(data.points, index).map(value => value.toFixed(2)), network.rays[index], ...sigma(network.limited, index), ...sigma(network.total_cov, index), ...(network.error ? triples(network.error, index).map(value => fixed(value)) : [])]);
  const table = document.createElement("table");
  table.innerHTML = `<thead><tr>${head.map(name => `<th><button type="button">${name}</button></th>`).join("")}</tr></thead><tbody>${rows.map(row => `<tr>${row.map(cell => `<td>${cell}</td>`).join("")}</tr>`).join("")}</tbody>`;
  table.addEventListener("click", event => { const header = event.target.closest("th"); if (header) sortTable(table, header); });
  box.append(table);
}

/* ------------------------------------------------------------------ start */
function step(by) {
  const rows = $$("#table tbody tr").map(row => Number(row.dataset.id));
  select(rows[(rows.indexOf(selected) + by + rows.length) % rows.length], false);
}
$("#previous").onclick = () => step(-1);
$("#next").onclick = () => step(1);
$("#recommended").onclick = () => select(data.knee, false);
$("#all").onchange = event => document.documentElement.classList.toggle("all", event.target.checked);
$("#theme").onclick = () => { const root = document.documentElement; root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark"; select(selected, false); };
for (const article of $$("article.network")) $("details.points", article).addEventListener("toggle", () => pointTable(article));
const links = new Map($$("nav a").map(link => [link.hash.slice(1), link]));
const watcher = new IntersectionObserver(entries => { for (const entry of entries) if (entry.isIntersecting) { links.forEach(link => link.classList.remove("here")); links.get(entry.target.id)?.classList.add("here"); } }, { rootMargin: "-20% 0px -70% 0px" });
$$("main section").forEach(section => watcher.observe(section));
const wanted = Number((location.hash.match(/^#network-(\d+)$/) || [])[1] ?? NaN);
select(byId.has(wanted) ? wanted : data.knee, byId.has(wanted));
listenFront(); listenTable();
const resizer = new ResizeObserver(entries => { for (const entry of entries) if (entry.target.layout && entry.contentRect.width) Plotly.Plots.resize(entry.target); });
$$(".plot").forEach(plot => resizer.observe(plot));
addEventListener("hashchange", () => { const id = Number((location.hash.match(/^#network-(\d+)$/) || [])[1] ?? NaN); if (byId.has(id) && id !== selected) select(id); });
})();
