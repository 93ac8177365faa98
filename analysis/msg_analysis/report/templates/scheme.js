"use strict";
// Plots in the colours of the scheme that the reader prefers; on paper, in those for white pages.
(() => {
  const light = Object.entries(JSON.parse(document.body.dataset.dark));
  const toDark = new Map(light), toLight = new Map(light.map(([one, other]) => [other, one]));
  const preferred = window.matchMedia("(prefers-color-scheme: dark)");
  let dark = false;

  // The colour to be used now for one of the colours for white pages.
  window.shade = (colour) => (dark ? toDark.get(colour) || colour : colour);

  const other = (value, map) => (typeof value === "string" ? map.get(value.toLowerCase()) : undefined);

  function repaint(model, map) {
    const changed = {};
    for (const property of model) {
      const name = property.attr;
      if (name === "tags" || name === "data" || !/colo|text|fill|line/.test(name)) continue;
      const value = model[name];
      const found = other(value, map), inner = value && typeof value === "object" ? other(value.value, map) : undefined;
      if (found) changed[name] = found;
      else if (inner) changed[name] = { ...value, value: inner };
    }
    if (Object.keys(changed).length > 0) model.setv(changed);
    if (model.type === "ColumnDataSource") {
      const columns = Object.entries(model.data).filter(([, column]) => column.length > 0 && other(column[0], map));
      if (columns.length > 0) {
        const painted = columns.map(([name, column]) => [name, Array.from(column, (each) => other(each, map) || each)]);
        model.data = { ...model.data, ...Object.fromEntries(painted) };
      }
    }
    if (/^(Linear|Log)ColorMapper$/.test(model.type) && model.tags.length > 0) {
      const [palette] = model.tags;
      model.tags = [model.palette];
      model.palette = palette;
    }
  }

  function paint(wanted) {
    const shown = window.Bokeh && window.Bokeh.documents[0];
    if (wanted === dark || !shown) return;
    dark = wanted;
    for (const model of shown.all_models) repaint(model, dark ? toDark : toLight);
  }

  window.paintPreferred = () => paint(preferred.matches);
  window.paintPaper = () => paint(false);
  preferred.addEventListener("change", window.paintPreferred);
})();
