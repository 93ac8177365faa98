"use strict";
// Plots on narrow screens, under a finger, and on paper.
(() => {
  // On narrow screens, legends have two columns, and axes fewer numbers.
  window.fitWidth = (shown) => {
    const narrow = document.body.clientWidth < 560, columns = narrow ? 2 : "auto";
    for (const one of shown.all_models) {
      if (one.type === "Legend" && one.ncols !== columns) one.ncols = columns;
      if (one.type === "BasicTicker" && one.tags.includes("agents")) one.desired_num_ticks = narrow ? 8 : 20;
    }
  };

  // A finger on a figure scrolls the page, until a tool is chosen; sideways it moves the frame of the overview.
  window.leaveScrolling = (view) => {
    if (!view.canvas_view) return;
    const { tools } = view.model.toolbar;
    for (const one of tools) if (["BoxZoomTool", "PanTool"].includes(one.type)) one.active = false;
    if (tools.some((one) => one.type === "RangeTool")) {
      view.canvas_view.touch_action.replace(".bk-events { touch-action: pan-y; }");
    }
  };

  // On paper nothing can be opened, and figures, which keep the width of the screen, would be cut: pictures are not.
  let closed = [], pictures = [];
  // Between two listeners, the plots take over the colours for white pages, and those not yet seen are drawn.
  window.addEventListener("beforeprint", () => window.paintPaper());
  window.addEventListener("beforeprint", () => window.drawAll());
  window.addEventListener("beforeprint", () => {
    closed = [...document.querySelectorAll("details:not([open])")];
    closed.forEach((one) => { one.open = true; });
    if (!window.Bokeh) return;
    for (const view of window.Bokeh.index.roots) {
      const place = view.el.closest(".plot") || view.el.getRootNode().host?.closest(".plot");
      if (!place || view.el.clientWidth === 0) continue;  // hidden
      view._actual_paint?.();  // at once: legends are empty until they are painted in new colours
      const canvas = view.export("png", true).canvas;
      const picture = new Image();
      picture.src = canvas.toDataURL();
      picture.style.width = `${view.el.clientWidth}px`;
      place.append(picture);
      place.classList.add("pictured");
      pictures.push([place, picture]);
    }
  });
  window.addEventListener("afterprint", () => {
    closed.forEach((one) => { one.open = false; });
    for (const [place, picture] of pictures) {
      picture.remove();
      place.classList.remove("pictured");
    }
    pictures = [];
    window.paintPreferred();
  });
})();
