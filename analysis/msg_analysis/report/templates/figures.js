"use strict";
// The figures: unpacked, and each drawn when it comes near the visible part of the page, or is printed.
(() => {
  const prepared = [], waiting = new Set();  // places of figures that have not been drawn
  let shown, views, unfinished = [];

  // Calls back with the document of all figures, before the first one is drawn.
  window.withFigures = (prepare) => prepared.push(prepare);

  async function unpack(id) {
    const block = document.getElementById(id);
    const text = atob(block.textContent), bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i += 1) bytes[i] = text.charCodeAt(i);
    block.remove();
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  }

  async function draw(place) {
    if (!waiting.delete(place)) return;
    near.unobserve(place);
    const view = await views.build_view(shown.get_model_by_id(place.dataset.figure));
    view.build(place);
    if (window.matchMedia("(pointer: coarse)").matches) window.leaveScrolling(view);
    unfinished.push(view);
  }

  const near = new IntersectionObserver(async (seen) => {
    await Promise.all(seen.filter((one) => one.isIntersecting).map((one) => draw(one.target)));
    tell();
  }, { rootMargin: "300px 0px" });

  // The page is ready as long as all that has come into view is drawn.
  function tell() {
    unfinished = unfinished.filter((view) => !view.has_finished());
    document.body.dataset.ready = unfinished.length ? "no" : "yes";
    if (unfinished.length) requestAnimationFrame(tell);
  }

  window.drawAll = () => Promise.all([...waiting].map(draw)).then(tell);

  async function start() {
    const [library, figures] = await Promise.all(["library", "figures"].map(unpack));
    const script = document.createElement("script");
    script.textContent = library;
    document.head.append(script);
    await window.Bokeh.embed.embed_items({ figures: JSON.parse(figures) }, []);
    [shown] = window.Bokeh.documents;
    views = await window.Bokeh.embed.add_document_standalone(shown, document.body);
    for (const prepare of prepared) prepare(shown);
    for (const place of document.querySelectorAll(".figure")) {
      waiting.add(place);
      near.observe(place);
    }
  }

  if (window.DecompressionStream) start();
  else document.getElementById("old-browser").hidden = false;
})();
