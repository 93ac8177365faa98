"use strict";
// Choosing agents: by numbers in the field, or in the figure; the table and the lines follow.
(() => {
  const COLOURS = JSON.parse(document.body.dataset.colours);
  const CANDIDATES = new Set(JSON.parse(document.body.dataset.candidates));
  const DASHES = ["solid", "dashed", "dotted", "dotdash"];
  const MOST = Number(document.body.dataset.most), MOST_BANDS = 3;
  const field = document.getElementById("agents");
  const said = document.getElementById("chosen");
  const rows = [...document.querySelectorAll("#node-table tbody tr")];
  const first = JSON.parse(document.body.dataset.first);
  let model = () => null;
  let busy = false;

  const NAMES = window.NAMES = JSON.parse(document.body.dataset.names);  // null: agents have only numbers
  window.called = (agent) => NAMES ? NAMES[agent - 1] : `${agent}`;
  window.parseAgents = (text, agents) => {
    const chosen = new Set();
    for (const part of text.split(NAMES ? /\s*[,;]\s*/ : /[\s,;]+/).map((each) => each.trim()).filter(Boolean)) {
      if (NAMES && NAMES.includes(part)) {
        chosen.add(NAMES.indexOf(part) + 1);
        continue;
      }
      const found = /^(\d+)(?:[-–](\d+))?$/.exec(part);
      const from = found ? Number(found[1]) : 0, to = found ? Number(found[2] || found[1]) : 0;
      if (!found || from < 1 || to > agents || from > to) return { wrong: part };
      for (let agent = from; agent <= to; agent += 1) chosen.add(agent);
    }
    return { agents: [...chosen].sort((a, b) => a - b) };
  };

  const colour = (agent) => window.shade(CANDIDATES.has(agent) ? document.body.dataset.alarm : COLOURS[(agent - 1) % COLOURS.length]);

  function draw(agents) {
    const lines = model("lines"), bands = model("bands"), all = model("all_agents");
    if (!lines || !all) return;
    const times = model("all_times").data.time, parts = all.data.part, widths = model("all_widths").data.width;
    const points = times.length, last = times[points - 1];
    const known = agents.filter((agent) => !Number.isNaN(parts[(agent - 1) * points + points - 1])).slice(0, MOST);
    const x = Array.from(times);
    lines.data = {
      xs: known.map(() => x),
      ys: known.map((agent) => Array.from(parts.slice((agent - 1) * points, agent * points))),
      agent: known.map((agent) => `agent ${window.called(agent)}`),
      colour: known.map(colour),
      width: known.map((agent) => (CANDIDATES.has(agent) ? 4 : 2)),
      dash: known.map((agent) => DASHES[Math.floor((agent - 1) / COLOURS.length) % DASHES.length]),
    };
    const banded = known.filter((agent) => known.length <= MOST_BANDS && Number.isFinite(widths[agent - 1]));
    bands.data = {
      xs: banded.map(() => x.concat(x.slice().reverse())),
      ys: banded.map((agent) => {
        const half = x.map((time) => widths[agent - 1] * Math.sqrt(last / time));
        return half.map((value) => 1 + value).concat(half.map((value) => 1 - value).reverse());
      }),
      colour: banded.map(colour),
    };
  }

  // agents: numbers from 1; none: all in the table, the first choice as lines.
  function choose(agents) {
    busy = true;
    const chosen = new Set(agents);
    rows.forEach((row, place) => { row.hidden = chosen.size > 0 && !chosen.has(place + 1); });
    if (chosen.size > 0) document.getElementById("node-details").open = true;
    const nodes = model("nodes");
    if (nodes) nodes.selected.indices = agents.map((agent) => agent - 1);
    draw(agents.length ? agents : first);
    said.textContent = agents.length > MOST ? `${agents.length} agents; lines of the first ${MOST}` :
      agents.length ? `${agents.length} of ${rows.length} agents` : "";
    busy = false;
  }

  window.withFigures((shown) => {
    window.paintPreferred();
    model = (name) => shown.get_model_by_name(name);
    const nodes = model("nodes");
    if (nodes) nodes.selected.properties.indices.change.connect(() => {
      if (busy) return;
      const agents = nodes.selected.indices.map((index) => index + 1).sort((a, b) => a - b);
      field.value = agents.map(window.called).join(", ");
      choose(agents);
    });
    choose([]);
    window.fitWidth(shown);
    window.addEventListener("resize", () => window.fitWidth(shown));
  });

  field.addEventListener("input", () => {
    const { agents, wrong } = window.parseAgents(field.value, rows.length);
    if (wrong === undefined) choose(agents);
    else said.textContent = `${wrong}: expected numbers from 1 to ${rows.length}, such as 3, 10-14`;
  });
  document.getElementById("all-agents").addEventListener("click", () => { field.value = ""; choose([]); });
})();
