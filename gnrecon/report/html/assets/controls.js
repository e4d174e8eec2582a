// Buttons, slider and pointer. The state is kept in the address after the #, as in #mode=error&points=1&axis=z&cut=0.4,
// so that a view can be shared.

const all = (selector) => [...document.querySelectorAll(selector)];

function readOut(found) {
  const place = found.place.map(coordinate).join(", ");
  if (!found.layer) return place;
  const value = found.value > -1e37 ? `${figure(found.value)} ${found.layer.unit}` : "no value";
  return `${found.layer.title} ${value}\n${place}`;
}

// Buttons carry data-set="key" and data-to="value"; a button without data-to switches between 0 and 1.
function controls(viewer) {
  const slider = byId("cut"), probe = byId("probe"), canvas = viewer.canvas;
  function refresh() {
    const known = all("[data-set=mode]").map((button) => button.dataset.to);
    if (!known.includes(state.mode)) state.mode = "plain";
    for (const button of all("[data-set]")) {
      const { set, to } = button.dataset;
      button.setAttribute("aria-pressed", state[set] === (to ?? "1"));
    }
    for (const legend of all("[data-legend]")) legend.hidden = legend.dataset.legend !== state.mode;
    byId("sliding").hidden = state.axis === "off";
    slider.value = state.cut;
    byId("cut-at").textContent = viewer.show();
    // A page within a notebook has no address that could hold the view.
    if (location.protocol !== "about:") history.replaceState(null, "", "#" + new URLSearchParams(state));
  }
  document.addEventListener("click", (event) => {
    const button = event.target.closest("[data-set]");
    if (!button) return;
    const { set, to } = button.dataset;
    state[set] = to ?? (state[set] === "1" ? "0" : "1");
    if (set === "axis") state.side = viewer.near(to);
    if (set === "view" || set === "up") viewer.look(state.view);
    if (button.dataset.jump) byId("model").scrollIntoView({ behavior: "smooth" });
    refresh();
  });
  slider.addEventListener("input", () => { state.cut = slider.value; refresh(); });
  byId("picture").addEventListener("click", () => canvas.toBlob((blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = "model.png";
    link.click();
    URL.revokeObjectURL(link.href);
  }));
  let pressed = false, asked = 0;
  canvas.addEventListener("pointerdown", () => { pressed = true; probe.hidden = true; });
  window.addEventListener("pointerup", () => { pressed = false; });
  viewer.controls.addEventListener("start", () => { viewer.moved = true; });
  canvas.addEventListener("pointermove", (event) => {
    if (pressed || event.pointerType === "touch") return;
    cancelAnimationFrame(asked);
    asked = requestAnimationFrame(() => {
      const found = viewer.probe(event);
      probe.hidden = !found;
      if (found) probe.textContent = readOut(found);
    });
  });
  canvas.addEventListener("pointerleave", () => { probe.hidden = true; });
  canvas.addEventListener("dblclick", (event) => {
    const found = viewer.probe(event);
    if (found) { viewer.controls.target.copy(found.world); viewer.controls.update(); viewer.draw(); }
  });
  // The wheel scrolls the page until the model has been clicked.
  canvas.addEventListener("focus", () => { viewer.controls.enableZoom = true; });
  canvas.addEventListener("blur", () => { viewer.controls.enableZoom = false; });
  canvas.addEventListener("pointerdown", () => canvas.focus({ preventScroll: true }));
  canvas.addEventListener("wheel", () => byId("hint").classList.toggle("shown", !viewer.controls.enableZoom));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => viewer.theme());
  new ResizeObserver(() => viewer.resize()).observe(canvas.parentElement);
  refresh();
}

function copying() {
  byId("copy")?.addEventListener("click", async (event) => {
    await navigator.clipboard.writeText(byId("command").textContent);
    event.target.textContent = "Copied";
  });
}

async function start() {
  copying();
  try {
    const viewer = new Viewer(byId("canvas"));
    await viewer.load();
    viewer.theme();
    viewer.resize();
    state.side ??= viewer.near(state.axis);
    controls(viewer);
    requestAnimationFrame(() => requestAnimationFrame(() => { document.documentElement.dataset.viewer = "ready"; }));
  } catch (error) {
    document.documentElement.dataset.viewer = "failed";
    byId("failure").hidden = false;
    console.error(error);
  }
}

start();
