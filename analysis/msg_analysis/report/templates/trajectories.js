"use strict";
// Trajectories: draws what is visible of the thinned run, for the agents that are switched on.
(() => {
  const box = document.getElementById("trajectories");
  if (!box) return;
  const COLOURS = JSON.parse(document.body.dataset.colours);
  const FIRST = JSON.parse(document.body.dataset.shown), CANDIDATES = new Set(JSON.parse(document.body.dataset.candidates));
  const DASHES = ["solid", "dashed", "dotted", "dotdash"];
  const MOST_STRIPS = 1500, MOST_BUTTONS = 120, OVERVIEW = 400, UNKNOWN = 65535;
  const from = document.getElementById("from"), to = document.getElementById("to");
  const field = document.getElementById("shown-agents"), buttons = document.getElementById("agent-buttons");
  const replica = document.getElementById("replica");  // null: there is one
  let model, scale, agents, time, bins, run, on, planned = false;

  const column = (source, name) => model(source).data[name];
  const bin = (value) => value / (scale.width * scale.dt);

  // The columns of a replica; those after the first are in whole numbers of 16 bits.
  const runs = new Map();
  function columnsOf(number) {
    if (!runs.has(number)) {
      const data = (label) => model(`thinned_${label}_${number}`).data, size = data("scale"), columns = {};
      for (const label of ["agents", "bins"]) for (const [name, whole] of Object.entries(data(label))) {
        const [unit] = size[`${name}_unit`] || [], [from] = size[`${name}_from`] || [];
        columns[name] = unit === undefined ? whole :
          Float32Array.from(whole, (value) => (value === UNKNOWN ? NaN : from + value * unit));
      }
      runs.set(number, { columns, width: size.width[0], dt: size.dt[0], agents: size.agents[0] });
    }
    return runs.get(number);
  }

  // The bins [first, last) of a series as a line of at most about two points per pixel.
  function line(low, high, offset, first, last, pixels) {
    const xs = [], ys = [], together = Math.max(1, Math.ceil((last - first) / pixels));
    const at = (place) => (place * scale.width + (scale.width - 1) / 2) * scale.dt;
    for (let start = first; start < last; start += together) {
      const end = Math.min(start + together, last);
      let least = NaN, most = NaN;
      for (let i = offset + start; i < offset + end; i += 1) {
        if (!(low[i] >= least)) least = Number.isNaN(low[i]) ? least : low[i];
        if (!(high[i] <= most)) most = Number.isNaN(high[i]) ? most : high[i];
      }
      const x = (at(start) + at(end - 1)) / 2, before = ys[ys.length - 1];
      const down = Math.abs(most - before) < Math.abs(least - before);  // the nearer end first: no saw-teeth
      xs.push(x);
      ys.push(down ? most : least);
      if (most > least) {
        xs.push(x);
        ys.push(down ? least : most);
      }
    }
    return [xs, ys];
  }

  function extremes(values, found) {
    for (const value of values) if (Number.isFinite(value)) {
      if (value < found[0]) found[0] = value;
      if (value > found[1]) found[1] = value;
    }
    return found;
  }

  function range(plot, [low, high], floor) {
    if (!(high >= low)) return;
    const margin = 0.06 * (high - low) || 1;
    plot.setv({ start: floor === undefined ? low - margin : floor, end: high + margin });
  }

  function drawStates(first, last, pixels) {
    const deviation = document.getElementById("deviation").checked, part = deviation ? "deviation_" : "";
    const low = run[`${part}low`], high = run[`${part}high`] || low;
    const chosen = [...on].sort((a, b) => CANDIDATES.has(a) - CANDIDATES.has(b) || a - b);  // the candidates on top
    const lines = chosen.map((agent) => line(low, high, (agent - 1) * bins, first, last, pixels));
    model("states").data = {
      xs: lines.map(([xs]) => xs), ys: lines.map(([, ys]) => ys),
      agent: chosen.map((agent) => `agent ${window.called(agent)}`),
      colour: chosen.map(colour), dash: chosen.map(dash),
      width: chosen.map((agent) => (CANDIDATES.has(agent) ? 2.4 : 1.3)),
    };
    const found = [Infinity, -Infinity];
    for (const [, ys] of lines) extremes(ys, found);
    const middle = deviation ? [[], []] : line(run.centre_low, run.centre_high, 0, first, last, pixels);
    if (deviation) middle[0].push(time.start, time.end), middle[1].push(0, 0);
    model("centre").data = { x: middle[0], y: middle[1] };
    extremes(middle[1], found);
    const band = { x: [], low: [], high: [] };
    if (on.size < agents) {
      const name = deviation ? "spread" : "band";
      const bottom = run[`${name}_low`], top = run[`${name}_high`];
      const step = Math.max(1, Math.ceil((last - first) / pixels));
      for (let start = first; start < last; start += step) {
        band.x.push((start + step / 2) * scale.width * scale.dt);
        const piece = [start, Math.min(start + step, last)];
        band.low.push(extremes(bottom.slice(...piece), [Infinity, -Infinity])[0]);
        band.high.push(extremes(top.slice(...piece), [Infinity, -Infinity])[1]);
      }
      extremes(band.low, found);
      extremes(band.high, found);
    }
    model("band").data = band;
    range(model("states_range"), found);
  }

  function drawError(first, last, pixels) {
    const [x, y] = line(run.error_low, run.error_high, 0, first, last, pixels);
    model("error").data = { x, y };
    const predicted = model("predicted");
    range(model("error_range"), extremes(predicted ? predicted.data_source.data.y : [], extremes(y, [0, 0])), 0);
  }

  // Intervals closer together than a pixel are drawn as one; the background is that which is longest in its pixels.
  function drawGraphs(pixels) {
    const starts = column("intervals", "start"), graphs = column("intervals", "graph");
    const names = column("graphs", "name"), colours = column("graphs", "colour");
    const lane = column("graphs", "lane");
    const gap = (time.end - time.start) / pixels, open = new Map(), lanes = [], strips = [];
    let place = Math.max(0, firstAfter(starts, time.start) - 1);
    let strip = null, longest = 0;
    for (; place < starts.length - 1 && starts[place] < time.end; place += 1) {
      const graph = graphs[place];
      if (graph < 0) continue;
      const left = starts[place], right = starts[place + 1], bar = open.get(graph);
      if (bar && left - bar.right < gap) bar.right = right;
      else {
        open.set(graph, { graph, left, right });
        lanes.push(open.get(graph));
      }
      if (strip && right - strip.left < 2 * gap) {
        if (right - left > longest) [longest, strip.graph] = [right - left, graph];
        strip.right = right;
      } else {
        strip = { graph, left, right };
        longest = right - left;
        strips.push(strip);
      }
    }
    const columns = (bars) => ({
      left: bars.map((bar) => bar.left), right: bars.map((bar) => bar.right),
      colour: bars.map((bar) => colours[bar.graph]),
    });
    model("lanes").data = { ...columns(lanes), graph: lanes.map((bar) => lane[bar.graph]), name: lanes.map((bar) => names[bar.graph]) };
    model("strips").data = columns(strips.length > MOST_STRIPS ? [] : strips);
    model("error_strips").data = columns(strips.length > MOST_STRIPS ? [] : strips);
  }

  function firstAfter(sorted, value) {
    let low = 0, high = sorted.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (sorted[middle] > value) high = middle;
      else low = middle + 1;
    }
    return low;
  }

  const colour = (agent) => window.shade(CANDIDATES.has(agent) ? document.body.dataset.alarm : COLOURS[(agent - 1) % COLOURS.length]);
  const dash = (agent) => DASHES[Math.floor((agent - 1) / COLOURS.length) % DASHES.length];

  function draw() {
    planned = false;
    const first = Math.max(0, Math.floor(bin(time.start)) - 1), last = Math.min(bins, Math.ceil(bin(time.end)) + 2);
    const pixels = Math.max(200, box.clientWidth - 100);
    drawStates(first, last, pixels);
    drawError(first, last, pixels);
    drawGraphs(pixels);
    if (document.activeElement !== from) from.value = Number(time.start.toPrecision(6));
    if (document.activeElement !== to) to.value = Number(time.end.toPrecision(6));
    box.dataset.drawn = "yes";
  }

  function plan() {
    if (planned) return;
    planned = true;
    requestAnimationFrame(draw);
  }

  function look(start, end) {
    const whole = time.bounds[1], length = Math.min(Math.max(end - start, 4 * scale.dt), whole);
    const begin = Math.min(Math.max(start, 0), whole - length);
    time.setv({ start: begin, end: begin + length });
  }

  function show(numbers) {
    on = new Set(numbers);
    for (const button of buttons.children) button.setAttribute("aria-pressed", on.has(Number(button.dataset.agent)));
    if (document.activeElement !== field) field.value = ranges([...on].sort((a, b) => a - b));
    plan();
  }

  function ranges(numbers) {
    if (window.NAMES) return numbers.map(window.called).join(", ");
    const parts = [];
    for (const number of numbers) {
      const last = parts[parts.length - 1];
      if (last && last[1] === number - 1) last[1] = number;
      else parts.push([number, number]);
    }
    return parts.map(([low, high]) => (low === high ? `${low}` : `${low}-${high}`)).join(", ");
  }

  function makeButtons() {
    if (agents > MOST_BUTTONS) return;
    for (let agent = 1; agent <= agents; agent += 1) {
      const button = document.createElement("button"), mark = document.createElement("i");
      button.type = "button";
      button.dataset.agent = agent;
      button.setAttribute("aria-label", `agent ${window.called(agent)}${CANDIDATES.has(agent) ? ", candidates" : ""}`);
      mark.style.borderTopColor = CANDIDATES.has(agent) ? "var(--disagrees)" : `var(--line-${(agent - 1) % COLOURS.length})`;
      mark.style.borderTopStyle = { dotdash: "dashed" }[dash(agent)] || dash(agent);
      button.append(mark, CANDIDATES.has(agent) ? `${window.called(agent)} ✗` : window.called(agent));
      button.addEventListener("click", () => {
        if (on.has(agent)) on.delete(agent);
        else on.add(agent);
        show(on);
      });
      buttons.append(button);
    }
  }

  function chooseReplica(number) {
    scale = columnsOf(number);
    run = scale.columns;
    agents = scale.agents;
    bins = run.error_low.length;
    document.getElementById("this-replica").textContent = number;
    document.getElementById("thinned").textContent =
      scale.width > 1 ? ` Smallest and largest value of every ${scale.width} steps.` : "";
    const points = Math.min(bins, OVERVIEW), x = Array.from({ length: points }, (_, i) => (i / (points - 1)) * time.bounds[1]);
    const piece = (ends, i) => ends.slice(Math.floor((i * bins) / points), Math.floor(((i + 1) * bins) / points));
    const most = (ends, which) => x.map((_, i) => extremes(piece(ends, i), [Infinity, -Infinity])[which])
      .map((value) => (Number.isFinite(value) ? value : NaN));
    model("overview").data = { x, low: most(run.band_low, 0), high: most(run.band_high, 1) };
  }

  window.withFigures((shown) => {
    model = (name) => shown.get_model_by_name(name);
    time = model("time");
    chooseReplica(1);
    for (const key of ["start", "end"]) time.properties[key].change.connect(plan);
    makeButtons();
    show(FIRST);
    draw();
    window.addEventListener("resize", plan);
  });

  if (replica) replica.addEventListener("change", () => {
    chooseReplica(Number(replica.value));
    plan();
  });

  const part = (start, end) => () => {
    const length = time.end - time.start;
    look(time.start + start * length, time.end + end * length);
  };
  const clicks = {
    earlier: part(-0.5, -0.5), later: part(0.5, 0.5), closer: part(0.25, -0.25), farther: part(-0.5, 0.5),
    whole: () => look(0, time.bounds[1]),
    "show-all": () => show(Array.from({ length: agents }, (_, i) => i + 1)),
    "show-none": () => show([]),
  };
  for (const [id, action] of Object.entries(clicks)) document.getElementById(id).addEventListener("click", action);
  for (const input of [from, to]) input.addEventListener("change", () => {
    const start = Number(from.value), end = Number(to.value), length = time.end - time.start;
    if (input.value === "") plan();
    else if (end > start) look(start, end);
    else if (input === from) look(start, start + length);
    else look(end - length, end);
  });
  document.getElementById("deviation").addEventListener("change", plan);
  field.addEventListener("input", () => {
    const chosen = window.parseAgents(field.value, agents);
    if (!chosen.wrong) show(chosen.agents);
  });
  for (const button of document.querySelectorAll(".events button")) button.addEventListener("click", () => {
    const length = Math.min(time.end - time.start, 200 * scale.dt), at = Number(button.dataset.time);
    look(at - length / 3, at + 2 * length / 3);
    box.scrollIntoView();
  });
})();
