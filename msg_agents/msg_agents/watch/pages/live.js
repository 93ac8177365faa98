"use strict";
const HALF = 1.96, COLOURS = 8, MOST_KEYS = 16, DASHES = ["", "6 3", "2 3"];
let setting = null, points = [], balls = [], links = new Map(), rows = [], scale = 0, over = false, newest = null, recent = null, off = new Set(), happened = [];

const number = (value, digits = 4) => value === null || value === undefined ? "–" : Number(value).toPrecision(digits);
const signed = (value) => value === null || value === undefined ? "–" : (value < 0 ? "−" : "+") + Math.abs(value).toFixed(2);
const millis = (seconds) => seconds === null || seconds === undefined ? "–" : `${(1000 * seconds).toFixed(seconds < 0.01 ? 1 : 0)} ms`;
const called = (agent) => setting.names ? setting.names[agent] : `${agent + 1}`;
const graphColour = (mode) => `var(--g${mode % COLOURS})`;
function lasting(seconds) {
  if (seconds === null) return "–";
  const whole = Math.ceil(seconds), rest = String(whole % 60).padStart(2, "0");
  return whole >= 3600 ? `${Math.floor(whole / 3600)}:${String(Math.floor(whole / 60) % 60).padStart(2, "0")}:${rest}` : `${Math.floor(whole / 60)}:${rest}`;
}
// A drawing with as many units as it has pixels, so that its text is never small; null while it is hidden.
function canvas(id, height) {
  const box = at(id), width = Math.round(box.getBoundingClientRect().width);
  box.replaceChildren();
  if (width < 50) return null;
  box.setAttribute("viewBox", `0 0 ${width} ${height}`);
  return { box, width, height };
}
// From purple over the neutral colour to orange; both ends can be told apart by everybody.
function colour(part) {
  const end = part > 0 ? [224, 130, 20] : [112, 70, 180], share = Math.min(Math.abs(part), 1);
  const middle = getComputedStyle(document.documentElement).getPropertyValue("--middle").split(",").map(Number);
  return `rgb(${end.map((value, place) => Math.round(middle[place] + share * (value - middle[place]))).join(",")})`;
}
function columns() {
  const late = setting.pace === "realtime";
  return ["agent", "step", "last step", "value", ...(late ? ["late"] : []), "error", "predicted", ...(late ? [] : ["z"])];
}

function begin(data) {
  setting = data; points = []; links = new Map(); scale = 0; newest = null; recent = null; off = new Set(); happened = [];
  at("name").textContent = `${data.name}: ${data.agents} agents, ${data.pace === "realtime" ? "real time" : data.pace}`;
  document.title = `${data.name}: live`;
  at("middle").textContent = data.reference === null ? "the mean" : `the reference ${data.reference}`;
  at("late-box").hidden = data.pace !== "realtime";
  say("", "the network is starting");
  const box = at("network");
  box.replaceChildren();
  box.classList.toggle("many", data.agents > 40);
  const xs = data.places.map((place) => place[0]), ys = data.places.map((place) => place[1]);
  const middle = [(Math.min(...xs) + Math.max(...xs)) / 2, (Math.min(...ys) + Math.max(...ys)) / 2];
  const size = Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys), 1e-9);
  const spot = data.places.map(([x, y]) => [150 + (x - middle[0]) / size * 256, 150 - (y - middle[1]) / size * 256]);
  data.graphs.forEach((graph, mode) => {
    for (const [a, b] of graph.links) {
      const key = `${Math.min(a, b)} ${Math.max(a, b)}`;
      if (!links.has(key)) {
        const [p, q] = [spot[a], spot[b]];
        links.set(key, { line: element("line", { x1: p[0], y1: p[1], x2: q[0], y2: q[1], class: "link" }, box), modes: new Set() });
      }
      links.get(key).modes.add(mode);
    }
  });
  const radius = data.agents <= 12 ? 13 : data.agents <= 40 ? 9 : 5;
  balls = spot.map(([x, y], agent) => {
    const group = element("g", {}, box), led = data.leaders.includes(agent + 1);
    const shape = led ? element("rect", { x: x - radius, y: y - radius, width: 2 * radius, height: 2 * radius, class: "ball" }, group)
      : element("circle", { cx: x, cy: y, r: radius, class: "ball" }, group);
    shape.setAttribute("fill", "#fff");
    const title = element("title", {}, group, `agent ${called(agent)}`);
    if (data.agents <= 40) element("text", { x, y, style: `font-size: ${radius}px`, "text-anchor": "middle", "dominant-baseline": "central", "pointer-events": "none" }, group, called(agent).slice(0, 8));
    return { shape, title };
  });
  at("columns").replaceChildren(...columns().map((name) => Object.assign(document.createElement("th"), { textContent: name, scope: "col", className: name === "step" ? "step" : "" })));
  const body = at("agents");
  body.replaceChildren();
  rows = balls.map((_, agent) => {
    const row = document.createElement("tr");
    for (let place = 0; place < columns().length; place += 1) row.append(document.createElement("td"));
    row.cells[0].textContent = called(agent) + (setting.external.includes(agent) ? " (external)" : "");
    row.cells[1].className = "step";
    row.cells[2].className = "fresh";
    body.append(row);
    return row;
  });
  at("agent-keys").replaceChildren();
  const named = data.graphs.length > MOST_KEYS ? [] : data.graphs;  // of more, the drawing has the name
  at("graph-keys").replaceChildren(...named.map((graph, mode) => {
    const key = Object.assign(document.createElement("span"), { className: "graph", textContent: graph.name });
    key.style.setProperty("--own", graphColour(mode));
    return key;
  }));
}

function keys(agents) {
  const box = at("agent-keys");
  if (box.children.length === agents) return;
  box.replaceChildren(...Array.from({ length: agents }, (_, agent) => {
    const key = Object.assign(document.createElement("button"), { type: "button", textContent: called(agent) });
    key.style.setProperty("--own", `var(--c${agent % COLOURS})`);
    key.setAttribute("aria-pressed", "true");
    key.setAttribute("aria-label", `agent ${called(agent)}`);
    key.addEventListener("click", () => {
      if (off.has(agent)) off.delete(agent); else off.add(agent);
      key.setAttribute("aria-pressed", String(!off.has(agent)));
      trace();
    });
    return key;
  }));
  at("trace-note").textContent = agents < setting.agents ? `The first ${agents} of ${setting.agents} agents.` : "";
}

function show(data) {
  if (!setting) return;
  if (!over) say(data.warning ? "late" : "", data.reached < 0 ? "the network is starting" : data.warning || (data.reached >= (data.last ?? setting.steps) ? "all steps are made: the run is closed and compared with the prediction" : "running"));
  const reached = Math.max(data.reached, 0);
  const last = data.last === null ? setting.steps : data.last;  // a run may end before its planned end
  at("progress").value = reached / last;
  at("step").textContent = `${reached} of ${last}`;
  at("time").textContent = number(reached * setting.dt);
  at("rate").textContent = data.rate.toFixed(0);
  at("left").textContent = lasting(data.left);
  if (data.graph !== null) {
    at("graph").textContent = setting.graphs[data.graph].name;
    at("network").style.setProperty("--own", graphColour(data.graph));
    for (const { line, modes } of links.values()) line.classList.toggle("active", modes.has(data.graph));
  }
  at("holding").textContent = data.holding ? `for ${number((reached - data.holding[1]) * setting.dt, 3)} units of time, from step ${data.holding[1]} to ${data.holding[2] + 1}; ${data.holding[0] - 1} jumps so far` : "";
  const gone = new Set(data.gone), finished = (agent) => data.steps.length && data.steps[agent] >= last;
  const silent = (agent) => !over && !finished(agent) && data.ages.length > 0 && data.ages[agent] > setting.silent && data.reached >= 0;
  const away = (agent) => gone.has(agent) || silent(agent);
  if (data.values) {
    const there = data.values.filter((value) => value !== null), mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
    const middle = setting.reference === null ? mean(there) : setting.reference;
    const square = mean(there.map((value) => (value - middle) ** 2));
    scale = scale ? scale + 0.1 * (square - scale) : square;
    data.values.forEach((value, agent) => {
      if (value === null) return;
      balls[agent].shape.setAttribute("fill", colour((value - middle) / (2 * Math.sqrt(scale) || 1)));
      balls[agent].title.textContent = `agent ${called(agent)}: ${number(value)} at step ${data.values_step}`;
    });
  }
  balls.forEach(({ shape, title }, agent) => {
    shape.classList.toggle("away", away(agent));
    if (gone.has(agent)) title.textContent = `agent ${called(agent)}: its process has ended`;
  });
  const system = data.system;
  at("note").textContent = data.note || "";
  if (system && system.measured !== null) {
    const half = system.standard_error === null ? null : HALF * system.standard_error;
    at("measured").textContent = number(system.measured);
    at("interval").textContent = half === null ? "–" : `${number(system.measured - half)} … ${number(system.measured + half)}`;
    at("predicted").textContent = number(system.predicted);
    const seen = data.any_time, wide = seen ? seen.half_width : null;
    at("anytime").textContent = wide === null ? "–" : `${number(system.measured - wide)} … ${number(system.measured + wide)}`;
    if (seen && seen.log_evidence !== null) {
      const evidence = seen.evidence === null ? "more than 1e300" : number(seen.evidence, 2);
      at("evidence").textContent = `${evidence} (${seen.exceeded ? `exceeded: ${seen.strongest}` : `threshold ${seen.threshold}`})`;
    }
    at("against").classList.toggle("far", Boolean(seen && seen.exceeded));
    const last = points[points.length - 1];
    if (!last || last[0] !== data.errors_step) points.push([data.errors_step, system.measured, system.predicted, system.standard_error]);
    if (points.length > 1200) points = points.filter((_, place) => place % 2 === 1);
  }
  const known = (data.lateness || []).filter((late) => late !== null).sort((a, b) => a - b);
  at("late").textContent = known.length ? millis(known[Math.floor(known.length / 2)]) : "–";
  rows.forEach((row, agent) => {
    const node = data.nodes ? data.nodes[agent] : null;
    const half = node && node.standard_error !== null ? HALF * node.standard_error : null;
    const step = data.steps.length ? data.steps[agent] : null;
    const age = data.ages.length && step !== null && step >= 0 ? data.ages[agent] : null;
    const fresh = gone.has(agent) ? "gone" : age === null ? null : finished(agent) ? "done" : away(agent) ? `${age.toFixed(1)} s ago` : "now";
    const cells = { step: step !== null && step >= 0 ? step : null, "last step": fresh, value: data.values ? number(data.values[agent], 3) : null,
      late: millis(data.lateness ? data.lateness[agent] : null), error: node ? number(node.measured) + (half === null ? "" : ` ± ${number(half, 2)}`) : null, predicted: node ? number(node.predicted) : null, z: node ? signed(node.z) : null };
    columns().slice(1).forEach((name, place) => { row.cells[place + 1].textContent = cells[name] === null || cells[name] === undefined ? "–" : cells[name]; });
    row.classList.toggle("far", Boolean(node && Math.abs(node.z) > 4));
    row.classList.toggle("away", away(agent));
  });
  if (JSON.stringify(data.events) !== JSON.stringify(happened)) {
    happened = data.events;
    at("no-events").hidden = happened.length > 0;
    at("events").replaceChildren(...happened.slice().reverse().map(([step, text]) => {
      const line = document.createElement("li"), where = document.createElement("b");
      where.textContent = step < 0 ? "start" : `step ${step}`;
      line.append(where, text);
      return line;
    }));
  }
  newest = data;
  draw();
  document.body.dataset.shown = Number(document.body.dataset.shown || 0) + 1;
}

function draw() { chart(); trace(); }

function trace() {
  if (!newest || !recent) return;
  const { steps, agents, path } = recent;
  keys(agents.length);
  const drawn = canvas("trace", 260);
  if (!drawn) return;
  const { box, width, height } = drawn, left = 46, right = width - 8, top = 6, bottom = height - 44;
  const first = steps[0], last = Math.max(steps[steps.length - 1], first + 1);
  const shown = agents.map((values, agent) => [agent, values]).filter(([agent]) => !off.has(agent));
  const all = shown.flatMap(([, values]) => values.filter((value) => value !== null)), reference = setting.reference;
  if (reference !== null) all.push(reference);
  if (!all.length) all.push(0);
  let low = Math.min(...all), high = Math.max(...all);
  const margin = (high - low) * 0.06 || 1;
  low -= margin; high += margin;
  const x = (step) => left + (step - first) / (last - first) * (right - left), y = (value) => bottom - (value - low) / (high - low) * (bottom - top);
  for (const [mode, from, to] of path) {
    const a = x(Math.max(from, first)), b = x(Math.min(to + 1, last));
    if (b <= a) continue;
    element("rect", { x: a, y: top, width: b - a, height: bottom - top, style: `fill: ${graphColour(mode)}; fill-opacity: var(--tint)` }, box);
    const strip = element("rect", { x: a, y: bottom + 3, width: b - a, height: 9, style: `fill: ${graphColour(mode)}` }, box);
    element("title", {}, strip, `${setting.graphs[mode].name}: steps ${from} to ${to + 1}`);
  }
  scaleOf(box, low, high, y, left, right);
  if (reference !== null) element("line", { x1: left, x2: right, y1: y(reference), y2: y(reference), class: "reference" }, box);
  for (const [agent, values] of shown) {
    const pieces = [];
    values.forEach((value, place) => {
      // A line joins successive steps only: what is missing stays a gap.
      if (value === null) return;
      if (!place || values[place - 1] === null || steps[place] !== steps[place - 1] + 1) pieces.push([]);
      pieces[pieces.length - 1].push(`${x(steps[place]).toFixed(1)},${y(value).toFixed(1)}`);
    });
    for (const piece of pieces) {
      if (piece.length < 2) piece.push(piece[0]);
      element("polyline", { points: piece.join(" "), class: "trace", style: `stroke: var(--c${agent % COLOURS})`, "stroke-dasharray": DASHES[Math.floor(agent / COLOURS) % 3], "stroke-linecap": "round" }, box);
    }
  }
  for (const [step, text] of happened.filter(([step]) => step >= first && step <= last)) marker(box, x(step), top, bottom, `step ${step}: ${text}`);
  element("text", { x: left, y: height - 14, "text-anchor": "start" }, box, `step ${first}`);
  element("text", { x: right, y: height - 14, "text-anchor": "end" }, box, `step ${last}`);
  element("text", { x: (left + right) / 2, y: height - 14, "text-anchor": "middle" }, box, `${number((last - first) * setting.dt, 3)} units of time`);
}

// Lines at round values.
function scaleOf(box, low, high, y, left, right) {
  const { values, decimals } = ticks(low, high, 6);
  for (const value of values) {
    const text = Math.abs(value) >= 1e5 || decimals > 5 ? number(value, 3) : value.toFixed(decimals);
    element("line", { x1: left, x2: right, y1: y(value), y2: y(value), class: "grid" }, box);
    element("text", { x: left - 5, y: y(value), "text-anchor": "end", "dominant-baseline": "central" }, box, text);
  }
}

function marker(box, x, top, bottom, text) {
  const line = element("line", { x1: x, x2: x, y1: top, y2: bottom, class: "event" }, box);
  element("title", {}, line, text);
  element("path", { d: `M ${x - 4} ${top} h 8 l -4 7 z`, style: "fill: var(--alarm)" }, box);
}

function chart() {
  const drawn = canvas("chart", 220);
  if (!drawn) return;
  const { box, width } = drawn, left = 48, right = width - 10, top = 8, bottom = 190;
  const known = points.filter((point) => point[1] !== null);
  if (known.length < 2) return;
  const late = known.slice(Math.min(Math.floor(known.length / 10), known.length - 2));
  const tops = late.flatMap(([, m, p, e]) => [m + HALF * (e || 0), m - HALF * (e || 0), p === null ? m : p]);
  const low = Math.max(Math.min(...tops), 0), high = Math.max(...tops), span = high - low || 1;
  const first = known[0][0], last = known[known.length - 1][0];
  const x = (step) => left + (step - first) / Math.max(last - first, 1) * (right - left);
  const y = (value) => Math.max(0, Math.min(bottom + 2, bottom - (value - low) / span * (bottom - top - 7)));
  scaleOf(box, low, high, y, left, right);
  for (const [step, anchor] of [[first, "start"], [last, "end"]]) element("text", { x: x(step), y: 208, "text-anchor": anchor }, box, `step ${step}`);
  const band = known.filter((point) => point[3] !== null);
  if (band.length > 1) {
    const upper = band.map(([s, m, , e]) => `${x(s)},${y(m + HALF * e)}`), lower = band.map(([s, m, , e]) => `${x(s)},${y(m - HALF * e)}`);
    element("polygon", { points: [...upper, ...lower.reverse()].join(" "), class: "interval" }, box);
  }
  element("polyline", { points: known.map(([s, m]) => `${x(s)},${y(m)}`).join(" "), class: "measured" }, box);
  const expected = known.filter((point) => point[2] !== null);
  element("polyline", { points: expected.map(([s, , p]) => `${x(s)},${y(p)}`).join(" "), class: "reference" }, box);
  for (const [step, text] of happened.filter(([step]) => step >= first && step <= last)) marker(box, x(step), top, bottom, `step ${step}: ${text}`);
}

function say(kind, words) {
  at("state").className = kind;
  at("state").textContent = words;
}

// The report is kept here: the run that serves this page is about to end.
async function keep(path) {
  try {
    const answer = await fetch("report");
    if (!answer.ok) return;
    at("report-link").href = URL.createObjectURL(new Blob([await answer.text()], { type: "text/html" }));
    at("report-path").textContent = path;
    at("report").hidden = false;
  } catch { /* it has been written all the same */ }
}

const events = new EventSource("events");
events.addEventListener("setting", (event) => begin(JSON.parse(event.data)));
events.addEventListener("history", (event) => { points = JSON.parse(event.data); chart(); });
events.addEventListener("trace", (event) => { recent = JSON.parse(event.data); });
events.addEventListener("moment", (event) => show(JSON.parse(event.data)));
events.addEventListener("end", (event) => {
  const { text, verdict, report } = JSON.parse(event.data);
  over = true;
  events.close();
  say(verdict || "over", text);
  if (newest) show(newest);
  if (report) keep(report);
  document.body.dataset.over = "yes";
});
let silence = 0;
events.addEventListener("open", () => clearTimeout(silence));
events.addEventListener("error", () => {
  clearTimeout(silence);
  silence = setTimeout(() => { if (!over) say("lost", "connection lost: the run may have ended"); }, 1500);
});
new ResizeObserver(draw).observe(document.body);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { if (newest) show(newest); });
