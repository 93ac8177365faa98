"use strict";
// The choice of the horizontal axis, and points by arrow keys.
(() => {
  let model = () => null;

  for (const choice of document.querySelectorAll("#along input")) {
    choice.addEventListener("change", () => {
      for (const one of document.querySelectorAll(".along")) one.hidden = one.dataset.place !== choice.value;
    });
  }

  // The next point in a direction of the keys: along the axis of x, or up and down at about the same x.
  const moves = { ArrowRight: 1, ArrowLeft: -1, ArrowUp: 1, ArrowDown: -1 };
  function next(points, present, key) {
    const { x, value } = points, sideways = key === "ArrowRight" || key === "ArrowLeft";
    const order = [...x.keys()].sort(sideways ? (a, b) => x[a] - x[b] || value[a] - value[b] : (a, b) => value[a] - value[b] || x[a] - x[b]);
    const at = present === undefined ? (moves[key] > 0 ? -1 : order.length) : order.indexOf(present);
    return order[Math.min(Math.max(at + moves[key], 0), order.length - 1)];
  }

  for (const place of document.querySelectorAll(".plot[data-name]")) {
    let present;
    const said = document.getElementById(`point-${place.dataset.name}`);
    const show = (points) => {
      const ring = model(`${place.dataset.name} ring`);
      ring.data = present === undefined ? { x: [], value: [] } : { x: [points.x[present]], value: [points.value[present]] };
      said.textContent = present === undefined ? "" : points.words[present];
    };
    place.addEventListener("keydown", (event) => {
      const found = model(`${place.dataset.name} points`);
      if (!found || (!(event.key in moves) && event.key !== "Escape")) return;
      event.preventDefault();
      present = event.key === "Escape" ? undefined : next(found.data, present, event.key);
      show(found.data);
    });
    place.addEventListener("blur", () => {
      const found = model(`${place.dataset.name} points`);
      present = undefined;
      if (found) show(found.data);
    });
  }

  // Values along an axis that do not fit beside each other are not all written.
  function fitValues(shown) {
    const width = document.querySelector(".panels .plot").clientWidth;
    for (const axis of shown.all_models) {
      if (!/Axis$/.test(axis.type) || axis.ticker.tags[0] !== "values") continue;
      const all = axis.ticker.tags[1], across = [...shown.all_models].some((one) => (one.below || []).includes(axis));
      const each = across ? Math.ceil((all.length * 56) / Math.max(width - 80, 56)) : 1;
      axis.ticker.ticks = all.filter((_, place) => place % each === 0);
    }
  }

  function fit(shown) {
    window.fitWidth(shown);
    fitValues(shown);
  }

  window.withFigures((shown) => {
    window.paintPreferred();
    model = (name) => shown.get_model_by_name(name);
    fit(shown);
    window.addEventListener("resize", () => fit(shown));
  });
})();
