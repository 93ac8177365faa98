"use strict";
{
  const data = JSON.parse(at("data").textContent), runs = data.runs;
  const body = at("runs").tBodies[0], rows = [...body.rows];
  let shown = [], points = [], active = -1, pair = [];

  const number = (value, digits = 4) => value === null ? "–" : String(Number(value.toPrecision(digits))).replace("-", "−");
  const signed = (value, digits = 3) => (value > 0 ? "+" : "") + number(value, digits);
  const interval = (run) => number(run.measured, 5) + (run.standard_error === null ? "" : ` ± ${number(data.half * run.standard_error, 2)}`);
  function node(kind, parent, text, attributes = {}) {
    const made = document.createElement(kind);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = text;
    parent.append(made);
    return made;
  }

  // Which runs are shown.
  function filter() {
    const name = at("name").value, words = at("search").value.toLowerCase().split(/\s+/).filter(Boolean);
    const verdicts = new Set([...document.querySelectorAll("[name=verdict]:checked")].map((box) => box.value));
    shown = runs.map((run, place) => place).filter((place) => {
      const run = runs[place], text = `${run.id} ${run.name} seed ${run.seed} ${run.when} ${run.word}`.toLowerCase();
      const parts = text.split(/\s+/);  // a short number is a seed, not a part of a date
      const found = (word) => /^\d{1,3}$/.test(word) ? parts.includes(word) : text.includes(word);
      return (!name || run.name === name) && verdicts.has(run.word) && words.every(found);
    });
    const kept = new Set(shown);
    for (const row of rows) row.hidden = !kept.has(Number(row.dataset.place));
    at("count").textContent = shown.length === runs.length ? "" : `${shown.length} of ${runs.length} runs`;
    at("none").hidden = shown.length > 0;
    draw();
  }

  // The table.
  function sort(head) {
    const key = head.dataset.key, down = head.getAttribute("aria-sort") === "ascending";
    for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const value = (row) => runs[row.dataset.place][key];
    rows.sort((one, other) => {
      const a = value(one), b = value(other);
      if (a === null || b === null) return (a === null) - (b === null);  // what is not known comes last
      const order = typeof a === "number" ? a - b : a.localeCompare(b, "en", { numeric: true });
      return down ? -order : order;
    });
    body.append(...rows);
  }

  // The plot: runs of one experiment, oldest first.
  function experiment() {
    if (at("name").value) return at("name").value;
    const counts = new Map();
    for (const place of shown) if (runs[place].measured !== null) counts.set(runs[place].name, (counts.get(runs[place].name) || 0) + 1);
    return [...counts].sort((a, b) => b[1] - a[1])[0]?.[0];
  }
  function draw() {
    const name = experiment(), box = at("plot");
    points = shown.filter((place) => runs[place].name === name && runs[place].measured !== null)
      .sort((a, b) => runs[a].date < runs[b].date ? -1 : 1);
    active = -1;
    at("overlay-title").textContent = name === undefined ? "System error" : `System error of ${name}`;
    at("point").className = "note";
    at("point").textContent = points.length ? "Point at a run, or use the arrow keys; a click or Enter chooses it for the comparison." : "No run with a measured error is shown.";
    at("coverage").textContent = "";
    box.replaceChildren();
    if (!points.length) return;
    const width = Math.max(box.clientWidth, 200), height = box.clientHeight, left = 56, right = 14, top = 14, bottom = 42;
    const svg = element("svg", { viewBox: `0 0 ${width} ${height}`, "aria-hidden": "true" }, box);
    const half = (run) => run.standard_error === null ? 0 : data.half * run.standard_error;
    const ends = points.flatMap((place) => [runs[place].measured - half(runs[place]), runs[place].measured + half(runs[place]), ...(runs[place].predicted === null ? [] : [runs[place].predicted])]);
    let low = Math.min(...ends), high = Math.max(...ends);
    const margin = 0.06 * (high - low) || Math.abs(high) * 0.1 || 1;
    low -= margin; high += margin;
    const x = (place) => left + (place + 0.5) / points.length * (width - left - right);
    const y = (value) => top + (high - value) / (high - low) * (height - top - bottom);
    for (const value of ticks(low, high, 5).values) {
      element("line", { class: "grid", x1: left, x2: width - right, y1: y(value), y2: y(value) }, svg);
      element("text", { x: left - 8, y: y(value) + 4, "text-anchor": "end" }, svg, number(value));
    }
    let day = null, free = -Infinity;  // the first run of a day has its date, where there is room
    points.forEach((place, i) => {
      const date = runs[place].when.slice(0, 10), spot = left + i / points.length * (width - left - right);
      if (date === day) return;
      day = date;
      element("line", { class: "tick", x1: spot, x2: spot, y1: height - bottom, y2: height - bottom + 5 }, svg);
      if (spot < free || spot + 72 > width) return;
      free = spot + 84;
      element("text", { x: spot, y: height - 24 }, svg, date);
    });
    element("text", { x: (left + width - right) / 2, y: height - 7, "text-anchor": "middle" }, svg, `${points.length} ${points.length === 1 ? "run" : "runs"}, oldest first`);
    const cell = (width - left - right) / points.length, size = Math.max(1.8, Math.min(5, cell / 2.2));
    svg.style.setProperty("--whisker", Math.max(0.6, Math.min(1.5, cell * 0.35)));
    points.forEach((place, i) => {
      const run = runs[place], kind = run.verdict === "agrees" || run.verdict === "disagrees" ? run.verdict : "other", cx = x(i), cy = y(run.measured);
      if (half(run)) element("line", { class: `whisker ${kind}`, x1: cx, x2: cx, y1: y(run.measured - half(run)), y2: y(run.measured + half(run)) }, svg);
      if (kind === "agrees") element("circle", { class: "dot agrees", cx, cy, r: size }, svg);
      else if (kind === "disagrees") element("path", { class: "dot disagrees", d: `M${cx} ${cy - size * 1.5}l${size * 1.4} ${size * 2.5}h${-size * 2.8}Z` }, svg);
      else element("rect", { class: "dot other", x: cx - size, y: cy - size, width: 2 * size, height: 2 * size }, svg);
    });
    let path = "", before = null;  // one line as long as the prediction stays the same
    points.forEach((place, i) => {
      const value = runs[place].predicted;
      if (value !== null) path += (value === before ? "H" : `M${x(i) - cell / 2} ${y(value)}H`) + (x(i) + cell / 2);
      before = value;
    });
    element("path", { class: "predicted", d: path }, svg);
    mark(svg);
    const known = points.map((place) => runs[place]).filter((run) => run.standard_error && run.predicted !== null);
    const inside = known.filter((run) => Math.abs(run.measured - run.predicted) <= half(run)).length;
    if (known.length) at("coverage").textContent = `${inside} of ${known.length} intervals contain the prediction (${number(100 * inside / known.length, 3)}\u00a0%; 95\u00a0% are expected).`;
    svg.addEventListener("pointermove", (event) => go(nearest(event)));
    svg.addEventListener("click", (event) => { go(nearest(event)); choose(points[active]); });
    function nearest(event) {
      const place = (event.clientX - box.getBoundingClientRect().left - left) / cell;
      return Math.max(0, Math.min(points.length - 1, Math.floor(place)));
    }
    draw.place = { x, y, svg };
  }
  function mark(svg = draw.place?.svg) {
    if (!svg) return;
    svg.querySelectorAll(".mine").forEach((one) => one.remove());
    if (!draw.place || draw.place.svg !== svg) queueMicrotask(() => mark());
    else [...pair.map((place, i) => [place, "AB"[i]]), [points[active], ""]].forEach(([place, label]) => {
      const i = points.indexOf(place);
      if (i < 0) return;
      const cx = draw.place.x(i), cy = draw.place.y(runs[place].measured);
      element("circle", { class: "mine ring", cx, cy, r: label ? 8 : 6 }, svg);
      const other = pair.find((one) => one !== place), below = other !== undefined && runs[other].measured > runs[place].measured;
      if (label) element("text", { class: "mine label", x: cx, y: cy + (below ? 21 : -12), "text-anchor": "middle" }, svg, label);
    });
  }
  function go(place) {
    if (!points.length || place === active) return;
    active = Math.max(0, Math.min(points.length - 1, place));
    const run = runs[points[active]];
    at("point").className = "";
    at("point").textContent = `${run.id}: ${interval(run)}${run.standard_error === null ? "" : " (95 %)"}, predicted ${number(run.predicted, 5)}` +
      (run.z === null ? "" : `, z = ${signed(run.z)}`) + `; ${run.word}, seed ${run.seed}`;
    mark();
  }

  // The difference of two runs.
  function choose(place) {
    pair = pair.includes(place) ? pair.filter((other) => other !== place) : [...pair, place].slice(-2);
    compare();
  }
  function group(table, title, keys, a, b) {
    const row = node("tr", table);
    node("th", row, keys.length ? title : `${title}: ${a && b ? "no difference" : "not known"}`, { colspan: 3, scope: "rowgroup" });
    for (const key of keys) line(table, key, a?.[key] ?? "–", b?.[key] ?? "–");
  }
  function line(table, title, a, b) {
    const row = node("tr", table);
    node("th", row, title, { scope: "row" });
    node("td", row, a, { "data-side": "A" });
    node("td", row, b, { "data-side": "B" });
  }
  function differing(a, b) {
    if (!a || !b) return [];
    return [...new Set([...Object.keys(a), ...Object.keys(b)])].filter((key) => a[key] !== b[key]);
  }
  function compare() {
    at("a").value = pair[0] ?? ""; at("b").value = pair[1] ?? "";
    for (const row of rows) {
      const chosen = pair.includes(Number(row.dataset.place));
      row.classList.toggle("chosen", chosen);
      row.querySelector("input").checked = chosen;
    }
    mark();
    const box = at("difference");
    box.replaceChildren();
    if (pair.length < 2) {
      node("p", box, "Choose two runs: here, in the plot, or in the table.", { class: "note" });
      return;
    }
    const [a, b] = pair.map((place) => runs[place]);
    if (a.measured !== null && b.measured !== null) {
      const size = b.measured - a.measured, error = a.standard_error && b.standard_error ? Math.hypot(a.standard_error, b.standard_error) : null;
      const words = error ? ` ± ${number(data.half * error, 2)} (95 %): ${signed(size / error)} standard errors` : "";
      node("p", box, `System error, B − A: ${signed(size)}${words}`, { class: "difference-line" });
      if (error && a.seed === b.seed) node("p", box, "Both runs have the same seed: their errors are not independent.", { class: "note" });
    }
    const whole = node("table", box), head = node("tr", node("thead", whole));
    for (const title of ["", "A", "B"]) node("th", head, title, { scope: "col" });
    const table = node("tbody", whole);
    line(table, "run", a.id, b.id);
    line(table, "date", a.when, b.when);
    line(table, "seed", String(a.seed ?? "–"), String(b.seed ?? "–"));
    line(table, "verdict", a.word, b.word);
    if (a.word !== b.word) table.lastChild.className = "differs";
    line(table, "simulated time", number(a.simulated_time), number(b.simulated_time));
    line(table, "system error", interval(a), interval(b));
    line(table, "predicted", number(a.predicted, 5), number(b.predicted, 5));
    line(table, "z", a.z === null ? "–" : signed(a.z), b.z === null ? "–" : signed(b.z));
    for (const [title, key] of [["Experiment", "experiment"], ["Versions", "versions"]]) {
      const [one, other] = [a, b].map((run) => data.documents[run[key]]);
      group(table, title, differing(one, other), one, other);
    }
  }

  for (const id of ["a", "b"]) {
    node("option", at(id), "–", { value: "" });
    runs.forEach((run, place) => node("option", at(id), run.id, { value: place }));
    at(id).addEventListener("change", () => { pair = [at("a").value, at("b").value].filter((value) => value !== "").map(Number); compare(); });
  }
  at("swap").addEventListener("click", () => { pair.reverse(); compare(); });
  for (const row of rows) row.querySelector("input").addEventListener("change", () => choose(Number(row.dataset.place)));
  for (const head of document.querySelectorAll("#runs th[data-key]")) head.querySelector("button").addEventListener("click", () => sort(head));
  at("filters").addEventListener("input", filter);
  at("filters").addEventListener("submit", (event) => event.preventDefault());
  at("plot").addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1, Home: -Infinity, End: Infinity }[event.key];
    if (step !== undefined && points.length) go(Math.max(0, Math.min(points.length - 1, (active < 0 ? (step > 0 ? -1 : points.length) : active) + step)));
    else if (event.key === "Enter" && active >= 0) choose(points[active]);
    else return;
    event.preventDefault();
  });
  let last = 0;
  new ResizeObserver(() => { if (at("plot").clientWidth !== last) { last = at("plot").clientWidth; draw(); } }).observe(at("plot"));
  filter();
  pair = [...points].slice(-2);
  compare();
  document.body.dataset.ready = "yes";
}
