// Measuring in scene.html: two clicks give a length with its 90 % interval. What is computed here is what
// lrfcal_lib.measure.features computes; tests compare the two.

function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
const minus = (a, b) => a.map((value, i) => value - b[i]);
const plus = (a, b, scale = 1) => a.map((value, i) => value + scale * b[i]);
const times = (a, scale) => a.map((value) => value * scale);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const norm = (a) => Math.sqrt(dot(a, a));
const applied = (rows, v) => rows.map((row) => dot(row, v));
const turned = (v, angle) => {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return [v[0], c * v[1] - s * v[2], s * v[1] + c * v[2]];
};
const quadratic = (v, flat) => {
  let sum = 0;
  for (let i = 0; i < v.length; i++) for (let j = 0; j < v.length; j++) sum += v[i] * flat[i * v.length + j] * v[j];
  return sum;
};

class Measurer {
  constructor(data) {
    this.data = data;
    this.rows = unpacked(data.features);
    this.width = this.rows.length / Math.max(data.kinds.length, 1);
    this.unknowns = data.unknowns;
    this.covariances = data.covariances.map(unpacked);
    this.stations = Object.keys(data.poses).map(Number);
  }

  // Places between the frame of the page and that of a station's platform.
  inStation(station, p) {
    const pose = this.data.poses[station];
    return applied(transposed(pose.R), minus(p, pose.t));
  }

  inPage(station, p) {
    const pose = this.data.poses[station];
    return plus(applied(pose.R, p), pose.t);
  }

  // A plane or an edge by its number, in the frame of its station: as lrfcal_lib.measure.features.Feature.
  feature(number) {
    const row = this.rows.subarray(number * this.width, (number + 1) * this.width);
    const m = this.unknowns + 3;
    const part = (from, count) => Array.from(row.subarray(from, from + count));
    const jacobian = [];
    for (let i = 0; i < 6; i++) jacobian.push(part(48 + i * m, m));
    return {
      kind: this.data.kinds[number], placement: this.data.placements[number], centre: part(0, 3), axis: part(3, 3),
      ends: [part(6, 3), part(9, 3)], noise: row.subarray(12, 48), jacobian,
    };
  }

  // The place on a plane, or on the line of an edge, that is nearest to another.
  foot(feature, place) {
    const along = times(feature.axis, dot(feature.axis, minus(place, feature.centre)));
    return feature.kind === "plane" ? minus(place, along) : plus(feature.centre, along);
  }

  // Whether a feature lies along an axis in the frame of its station, as Feature.lies_along.
  liesAlong(feature, axis) {
    return !axis || Math.abs(dot(feature.axis, axis)) > Math.cos(this.data.alike);
  }

  // The edge of a station along an axis that passes closest to a place in its frame, and how close, metres.
  nearestEdge(station, place, axis) {
    let best = { away: Infinity };
    this.data.kinds.forEach((kind, number) => {
      if (kind !== "edge" || this.data.placements[number] !== station) return;
      const feature = this.feature(number);
      if (!this.liesAlong(feature, axis)) return;
      const way = minus(feature.ends[1], feature.ends[0]);
      const along = Math.min(Math.max(dot(minus(place, feature.ends[0]), way) / dot(way, way), 0), 1);
      const away = norm(minus(plus(feature.ends[0], way, along), place));
      if (away < best.away) best = { away, feature };
    });
    return best;
  }

  // The features by station that are one with the clicked one: `nearest` gives a station's next to a place.
  shown(clicked, place, nearest) {
    const foot = this.foot(clicked, this.inStation(clicked.placement, place));
    const there = this.inPage(clicked.placement, foot);
    const features = { [clicked.placement]: clicked };
    for (const station of this.stations) {
      if (station === clicked.placement) continue;
      const own = this.inStation(station, there);
      const inPage = applied(this.data.poses[clicked.placement].R, clicked.axis);
      const axis = applied(transposed(this.data.poses[station].R), inPage);
      const { away, feature } = nearest(station, own, axis);
      if (away < this.data.reach && norm(minus(this.foot(feature, own), own)) < this.data.on_it) features[station] = feature;
    }
    return { place: there, features };
  }

  // The middle of some points of one scan, in the frame of its platform.
  point(points, placement) {
    const m = this.unknowns + 3;
    const jacobian = Array.from({ length: 6 }, () => new Array(m).fill(0));
    const noise = new Float64Array(36);
    const centre = times(points.reduce((sum, p) => plus(sum, p), [0, 0, 0]), 1 / points.length);
    for (const p of points) {
      const moved = this.beam(p);
      moved.columns.forEach((column) => {
        for (let i = 0; i < 3; i++) jacobian[i][column.at] += column.by[i] / points.length;
      });
      for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++)
        noise[6 * i + j] += (this.data.range_noise / points.length) ** 2 * moved.beam[i] * moved.beam[j];
    }
    return { kind: "point", placement, centre, axis: [0, 0, 0], noise, jacobian };
  }

  // What moves the end of a beam, in the frame of its platform: see judge.uncertainty.carried and beams_to.
  beam(p) {
    const R = this.data.head.map((row) => row.slice(0, 3));
    const t = this.data.head.map((row) => row[3]);
    const k = R.map((row) => row[2]);
    const [a, b] = [k[1] * p[1] + k[2] * p[2], k[1] * p[2] - k[2] * p[1]];
    const pitch = Math.atan2(b, a) + Math.acos((dot(k, t) - k[0] * p[0]) / Math.hypot(a, b));
    const turn = ((pitch + 3 * Math.PI) % (2 * Math.PI)) - Math.PI;
    const head = minus(turned(p, -turn), t);
    const beam = turned(times(head, 1 / norm(head)), turn);
    const byPitch = cross([1, 0, 0], p);
    const at = this.data.columns;
    const columns = [];
    const add = (place, by) => { if (place >= 0) columns.push({ at: place, by }); };
    for (const axis of [1, 2]) {
      const unit = [0, 0, 0];
      unit[axis] = 1;
      add(at[axis - 1], minus(cross(minus(p, t), unit), turned(cross(head, unit), turn)));
      add(at[axis + 1], minus(turned(unit, turn), unit));
    }
    add(at[10], times(beam, -1));
    add(at[11], times(byPitch, turn));
    add(this.unknowns, byPitch);
    add(this.unknowns + 1, times(byPitch, turn));
    return { beam, columns };
  }

  // Length between two features of a station, the variance of what only this station has wrong, and derivatives by
  // what all have wrong alike; a text where there is none.
  between(first, second) {
    if (isSame(first, second)) return `both places are on the same ${first.kind}: pick two, or two points of it`;
    const order = ["point", "edge", "plane"];
    const kind = order[Math.max(order.indexOf(first.kind), order.indexOf(second.kind))];
    if (first.kind !== "point" && second.kind !== "point") {
      let angle = Math.acos(Math.min(Math.abs(dot(first.axis, second.axis)), 1));
      if (first.kind !== second.kind) angle = Math.PI / 2 - angle;
      if (angle > this.data.alike) return `${first.kind} and ${second.kind} are ${(angle * 57.2958).toFixed(0)} deg from parallel: pick two that are, or points of them`;
    }
    const weights = [first, second].map((f) =>
      f.kind === kind && kind !== "point" ? 1 / Math.max(f.noise[21] + f.noise[28] + f.noise[35], 1e-12) : 0);
    const total = Math.max(weights[0] + weights[1], 1e-12);
    if (dot(first.axis, second.axis) < 0) weights[1] = -weights[1];
    const lengthOf = (place) => {
      const way = minus(place.slice(6, 9), place.slice(0, 3));
      let along = plus(times(place.slice(3, 6), weights[0] / total), place.slice(9, 12), weights[1] / total);
      along = times(along, 1 / Math.max(norm(along), 1e-12));
      const share = dot(along, way);
      return kind === "plane" ? Math.abs(share) : norm(plus(way, along, -share));
    };
    const place = [...first.centre, ...first.axis, ...second.centre, ...second.axis];
    const gradient = place.map((_, i) => {
      const step = (size) => place.map((value, k) => (k === i ? value + size : value));
      return (lengthOf(step(1e-6)) - lengthOf(step(-1e-6))) / 2e-6;
    });
    const parts = [gradient.slice(0, 6), gradient.slice(6)];
    let variance = quadratic(parts[0], first.noise) + quadratic(parts[1], second.noise);
    const moved = [first, second].map((f, i) =>
      f.jacobian[0].map((_, k) => f.jacobian.reduce((sum, row, j) => sum + parts[i][j] * row[k], 0)));
    const n = this.unknowns;
    for (const k of [0, 1]) {
      const [a, b] = [moved[0][n + k], moved[1][n + k]];
      const square = first.placement === second.placement ? (a + b) ** 2 : a * a + b * b;
      variance += square * this.data.sweep_sigma[k] ** 2;
    }
    const shared = [...plus(moved[0], moved[1]).slice(0, n), moved[0][n + 2], moved[1][n + 2]];
    return this.known({ length: lengthOf(place), noise: variance, shared });
  }

  // The same with its standard deviation.
  known(length) {
    const n = this.unknowns;
    const surfaces = this.data.systematic ** 2 * (length.shared[n] ** 2 + length.shared[n + 1] ** 2);
    const ofRig = Math.max(...this.covariances.map((C) => quadratic(length.shared.slice(0, n), C)));
    return { ...length, sigma: Math.sqrt(length.noise + surfaces + ofRig) };
  }

  // One length of what several stations measured, each weighted by how well it knows it.
  mean(lengths) {
    const total = lengths.reduce((sum, each) => sum + each.sigma ** -2, 0);
    const weights = lengths.map((each) => each.sigma ** -2 / total);
    const sum = (of) => lengths.reduce((all, each, i) => all + of(each, weights[i]), 0);
    return this.known({
      length: sum((each, w) => w * each.length), noise: sum((each, w) => w * w * each.noise),
      shared: lengths[0].shared.map((_, k) => sum((each, w) => w * each.shared[k])),
    });
  }

  // The length between the features of two picks; a text where there is none.
  measured(first, second) {
    const both = Object.keys(first.features).filter((station) => station in second.features);
    if (!both.length) return "no station shows both places: pick places that one of them shows";
    const apart = both.filter((station) => !isSame(first.features[station], second.features[station]));
    const lengths = (apart.length ? apart : both).map((station) => this.between(first.features[station], second.features[station]));
    return lengths.find((each) => typeof each === "string") || this.mean(lengths);
  }
}

const isSame = (first, second) => norm(minus(first.centre, second.centre)) === 0;
const transposed = (R) => R[0].map((_, i) => R.map((row) => row[i]));

// The list of lengths as CSV: `measure --picks` reads it.
function asCsv(list) {
  const ends = [1, 2].flatMap((k) => [`kind_${k}`, `x_m_${k}`, `y_m_${k}`, `z_m_${k}`]);
  const lines = [["name", ...ends, "length_m", "low_m", "high_m"].join(",")];
  for (const row of list) {
    const places = row.picks.flatMap((pick) => [pick.kind, ...pick.place.map((value) => value.toFixed(5))]);
    const name = `"${row.name.replaceAll('"', '""')}"`;
    lines.push([name, ...places, ...[row.length, row.low, row.high].map((value) => value.toFixed(6))].join(","));
  }
  return lines.join("\n") + "\n";
}

// Orbit by dragging; the wheel comes closer by a tenth, never through what is looked at.
function slowWheel(page) {
  page.addEventListener("wheel", (event) => {
    event.preventDefault();
    event.stopPropagation();
    const camera = page._fullLayout.scene._scene.getCamera();
    const way = ["x", "y", "z"].map((axis) => camera.eye[axis] - camera.center[axis]);
    const scale = Math.max(event.deltaY > 0 ? 1.1 : 1 / 1.1, 0.05 / norm(way));
    ["x", "y", "z"].forEach((axis, i) => { camera.eye[axis] = camera.center[axis] + scale * way[i]; });
    Plotly.relayout(page, { "scene.camera": camera });
  }, { capture: true, passive: false });
}

function panel(page, data) {
  const box = document.createElement("div");
  box.id = "measure";
  box.style.cssText = "position:fixed;right:8px;bottom:8px;max-width:26em;padding:8px;background:#fffd;font:13px sans-serif;border:1px solid #bbb";
  box.innerHTML = "<div id='pointer'>&nbsp;</div>";
  document.body.append(box);
  const say = (text) => { box.querySelector("#pointer").textContent = text; };
  const placeOf = (event) => ["x", "y", "z"].map((axis) => event.points[0][axis]);
  const inWords = (place) => `x ${place[0].toFixed(3)}, y ${place[1].toFixed(3)}, z ${place[2].toFixed(3)} m`;
  let hovered = null;
  page.on("plotly_hover", (event) => { hovered = event; say(inWords(placeOf(event))); });
  page.on("plotly_unhover", () => { hovered = null; });
  if (!data) return;
  const measurer = new Measurer(data);
  const planes = data.plane_of_point.map((text) => unpacked(text));
  const stations = data.station_of_point.map((text) => unpacked(text));
  const list = [];
  let picked = [];
  box.insertAdjacentHTML("beforeend",
    "click two: " + ["plane", "edge", "point"].map((kind, i) =>
      `<label><input type='radio' name='kind' value='${kind}' ${i ? "" : "checked"}> ${kind} </label>`).join("") +
    "<table id='lengths' style='border-collapse:collapse'></table>" +
    "<button id='undo'>remove last</button> <button id='save'>save as CSV</button>");
  const mode = () => box.querySelector("input:checked").value;
  box.querySelectorAll("input").forEach((input) => input.addEventListener("change", () =>
    Plotly.restyle(page, { visible: mode() === "edge" ? true : "legendonly" }, [data.edges_trace])));

  // All points of the page with their station and plane, nearest first, of those within reach that fit.
  function near(place, fits) {
    const found = [];
    page.data.slice(0, 2).forEach((trace, k) => {
      const [x, y, z] = ["x", "y", "z"].map((axis) => unpacked(trace[axis].bdata));
      for (let i = 0; i < x.length; i++) {
        const away = Math.hypot(x[i] - place[0], y[i] - place[1], z[i] - place[2]);
        if (away < data.reach && fits(stations[k][i], planes[k][i])) found.push({ away, plane: planes[k][i], p: [x[i], y[i], z[i]] });
      }
    });
    return found.sort((a, b) => a.away - b.away);
  }

  // The plane of a station, of those along an axis, that the points nearest to a place in its frame lie on as a whole.
  function nearestPlane(station, place, axis) {
    const fits = (s, number) => s === station && number >= 0 && measurer.liesAlong(measurer.feature(number), axis);
    const about = near(measurer.inPage(station, place), fits).slice(0, data.about);
    if (!about.length) return { away: Infinity };
    // at a crease the nearest point tells which way the surface faces
    if (!axis) return nearestPlane(station, place, measurer.feature(about[0].plane).axis);
    const sum = about.reduce((total, each) => plus(total, measurer.inStation(station, each.p)), [0, 0, 0]);
    const middle = times(sum, 1 / about.length);
    const off = (plane) => norm(minus(measurer.foot(plane, middle), middle));
    const candidates = [...new Set(about.map((each) => each.plane))].map((plane) => measurer.feature(plane));
    return { away: about[0].away, feature: candidates.reduce((a, b) => (off(b) < off(a) ? b : a)) };
  }

  function at(kind, place, curve, number) {
    const own = stations[curve][number];
    if (kind === "plane") {
      if (planes[curve][number] < 0) return "no flat surface here: pick an edge or a point";
      const clicked = nearestPlane(own, measurer.inStation(own, place));
      return measurer.shown(clicked.feature, place, nearestPlane);
    }
    if (kind === "edge") {
      const nearest = (station, there, axis) => measurer.nearestEdge(station, there, axis);
      const edges = measurer.stations.map((station) => nearest(station, measurer.inStation(station, place)));
      const edge = edges.reduce((a, b) => (b.away < a.away ? b : a));
      if (edge.away > data.reach) return "no edge within 10 cm: pick another place, or a point";
      return measurer.shown(edge.feature, place, nearest);
    }
    const points = near(place, (station) => station === own).slice(0, data.about);
    const feature = measurer.point(points.map((each) => measurer.inStation(own, each.p)), own);
    return { place, features: { [own]: feature } };
  }

  function pick(kind, place, curve, number) {
    const found = at(kind, place, curve, number);
    if (typeof found === "string") return say(found);
    picked.push({ kind, ...found });
    say(`${kind} at ${inWords(found.place)}: now the second`);
    if (picked.length === 2) {
      const result = measurer.measured(...picked);
      if (typeof result === "string") say(result);
      else {
        const half = data.ninety * result.sigma;
        list.push({ name: `length ${list.length + 1}`, picks: picked, length: result.length,
          low: Math.max(result.length - half, 0), high: result.length + half });
        say("");
      }
      picked = [];
    }
    show();
  }

  function show() {
    const rows = list.map((row, i) =>
      `<tr><td contenteditable data-row='${i}'></td><td style='text-align:right;padding-left:1em'>${(1000 * row.length).toFixed(1)} mm</td>` +
      `<td style='padding-left:1em'>90 %: ${(1000 * row.low).toFixed(1)} to ${(1000 * row.high).toFixed(1)}</td></tr>`);
    const table = box.querySelector("#lengths");
    table.innerHTML = rows.join("");
    table.querySelectorAll("[data-row]").forEach((cell) => {
      cell.textContent = list[cell.dataset.row].name;
      cell.addEventListener("input", () => { list[cell.dataset.row].name = cell.textContent; });
    });
    const pairs = [...list.map((row) => row.picks), picked].filter((pair) => pair.length);
    const along = (axis) => pairs.flatMap((pair) => [...pair.map((each) => each.place[axis]), null]);
    Plotly.restyle(page, { x: [along(0)], y: [along(1)], z: [along(2)] }, [data.lengths_trace]);
  }

  // not plotly_click, which comes with every picture that is drawn while a button is down
  let down = null;
  const scene = page.querySelector(".gl-container") || page;
  scene.addEventListener("mousedown", (event) => { down = { x: event.clientX, y: event.clientY, hovered }; }, true);
  window.addEventListener("mouseup", (event) => {
    const still = down && Math.hypot(event.clientX - down.x, event.clientY - down.y) < 4;
    const on = still && down.hovered;
    down = null;
    if (!on) return;
    const { curveNumber, pointNumber } = on.points[0];
    if (curveNumber < 2) pick(mode(), placeOf(on), curveNumber, pointNumber);
  }, true);
  box.querySelector("#undo").addEventListener("click", () => { if (picked.length) picked = []; else list.pop(); show(); });
  box.querySelector("#save").addEventListener("click", () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([asCsv(list)], { type: "text/csv" }));
    link.download = "picks.csv";
    link.click();
  });
  window.measuring = { measurer, pick, list, csv: () => asCsv(list) };
}
