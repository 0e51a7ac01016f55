// The controls of `simdesign open`: sends the values of the sliders to the server, and draws its answers with plots.js.
// While an answer is awaited, only the latest change waits, so that the figures follow a moving slider.
"use strict";
(() => {
  const get = (id) => document.getElementById(id), read = (id) => JSON.parse(get(id).textContent);
  const setting = read("setting"), figures = Object.fromEntries(read("figures").map((f) => [f.name, f]));
  const state = { point: setting.first, plane: setting.planes[0], kind: setting.kind, vehicle: {}, edits: {} };
  let references = read("shown").references, past = [], ahead = [], inputs = [];
  const make = (parent, tag, text = "", attributes = {}) => {
    const it = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) it.setAttribute(name, value);
    it.textContent = text;
    return parent.appendChild(it);
  };
  const shown = (value) => Math.abs(value) >= 1e4 || (value && Math.abs(value) < 1e-3) ? value.toExponential(2) : String(+value.toPrecision(4));
  const say = (text, bad = false) => { get("said").textContent = text; get("said").className = bad ? "bad" : "dim"; };

  // the server

  async function ask(path, body) {
    const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
    const found = await answer.json();
    if (!answer.ok) throw new Error(found.error);
    return found;
  }

  let busy = false, waiting = null;
  async function follow(reference = false) {
    const since = performance.now();
    if (busy) { waiting = { reference: reference || Boolean(waiting && waiting.reference) }; return; }
    busy = true;
    get("latency").dataset.busy = "yes"; // until nothing more will be drawn
    try {
      const found = await ask("show", { ...state, reference });
      if (found.references) references = found.references;
      draw(found.trial, !found.references);
      const whole = performance.now() - since;
      get("latency").textContent = `server ${found.ms.toFixed(0)} ms, change to drawn figures ${whole.toFixed(0)} ms`;
      get("latency").dataset.ms = whole;
      get("latency").dataset.server = found.ms;
      say("");
    } catch (problem) { say(problem.message === "Failed to fetch" ? "the command has ended: no further changes" : problem.message, true); }
    busy = false;
    if (!still && !waiting) delete get("latency").dataset.busy;
    if (waiting) { const next = waiting; waiting = null; follow(next.reference); }
  }

  let still = 0;
  function draw(trial, quick = false) {
    clearTimeout(still);
    still = quick ? setTimeout(() => { draw(trial); if (!busy) delete get("latency").dataset.busy; }, 250) : 0;
    const others = [...references].reverse(), every = [...others, trial], loop = figures.loop.panels;
    maxqFigures.update({ name: "loop", quick, panels: loop.map(() => ({ series: every.map((one) => one.curve) })) });
    const axis = figures.locus.panels[0].series.filter((s) => s.kind === "at");
    maxqFigures.update({ name: "locus", quick, panels: [{ series: [...every.flatMap((one) => one.locus), ...axis] }] });
    const unit = figures.time.panels[0].series.filter((s) => s.kind === "limit");
    maxqFigures.update({ name: "time", quick, panels: figures.time.panels.map((_, k) => ({ series: [...every.flatMap((one) => [...one.step, ...one.gust][k] || []), ...(k ? [] : unit)] })) });
    const missed = trial.rows.filter((row) => row[5] !== "met");
    const tone = trial.stable && !missed.length ? "good" : "bad", box = get("outcome");
    box.className = `outcome ${tone}`;
    box.querySelector("b").textContent = !trial.stable ? "UNSTABLE" : missed.length ? `${missed.length} of ${trial.rows.length} limits missed` : trial.rows.length > 1 ? "all limits met at this operating point" : "stable; the design states no limits";
    box.querySelector("p").textContent = trial.text;
    const body = get("limits").tBodies[0];
    body.replaceChildren();
    for (const [text, limit, value, left, , outcome] of trial.rows) {
      const row = make(body, "tr");
      [text, limit.replace(">= ", "≥\u00a0").replace("<= ", "≤\u00a0"), value, left].forEach((cell, k) => make(row, "td", cell, k ? { class: "n" } : {}));
      make(row, "td", outcome, { class: outcome === "met" ? "good" : "bad" });
    }
    get("limits").hidden = trial.rows.length < 2;
  }

  // sliders

  const stage = () => setting.points[state.point].stage;
  const value = (s) => s.key in state.edits ? state.edits[s.key] : s.value;
  const place = (s, v) => s.log ? 1000 * Math.log(v / s.low) / Math.log(s.high / s.low) : 1000 * (v - s.low) / (s.high - s.low);
  const number = (s, at) => s.log ? s.low * (s.high / s.low) ** (at / 1000) : s.low + (s.high - s.low) * at / 1000;
  const named = (s, v) => s.shown ? `${shown(v * s.shown[state.point])}${s.unit ? " " + s.unit : ""} (× ${shown(v)})` : `${shown(v)}${s.unit ? " " + s.unit : ""}`;

  function slider(parent, s, get_, set) {
    const label = make(parent, "label", "", { class: "slide" });
    make(label, "span", s.label);
    const said = make(label, "output"), input = make(label, "input", "", { type: "range", min: 0, max: 1000, step: "any" });
    const show = () => {
      input.value = place(s, get_());
      said.textContent = named(s, get_());
      input.setAttribute("aria-valuetext", said.textContent);
      label.classList.toggle("changed", get_() !== s.value);
    };
    let before = null;
    input.addEventListener("input", () => { before = before || snapshot(); set(number(s, +input.value)); said.textContent = named(s, get_()); label.classList.add("changed"); follow(set.reference); });
    input.addEventListener("change", () => { if (before) remember(before); before = null; show(); });
    input.addEventListener("keydown", (event) => { // steps of a hundredth; with Shift of a tenth
      const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
      if (!way) return;
      event.preventDefault();
      const was = snapshot(), at = Math.min(Math.max(+input.value + way * (event.shiftKey ? 100 : 10), 0), 1000);
      set(number(s, at));
      remember(was);
      show();
      follow(set.reference);
    });
    input.addEventListener("dblclick", () => { remember(snapshot()); set(s.value); show(); follow(set.reference); });
    show();
    inputs.push(show);
  }

  function sliders() {
    const parent = get("sliders"), groups = {};
    parent.replaceChildren();
    inputs = [];
    for (const s of setting.sliders[stage()]) {
      const box = groups[s.group] || (groups[s.group] = make(parent, "fieldset"));
      if (!box.childElementCount) make(box, "legend", s.group);
      slider(box, s, () => value(s), (v) => { if (v === s.value) delete state.edits[s.key]; else state.edits[s.key] = v; });
    }
    const box = get("vehicle");
    box.querySelectorAll("label").forEach((it) => it.remove());
    for (const [key, [start, low, high]] of Object.entries(setting.vehicle)) {
      const s = { label: key.replaceAll("_", " ").replace(" ms", ""), unit: key.endsWith("_ms") ? "ms" : "", value: start, low, high, log: false };
      const set = (v) => { if (v === start) delete state.vehicle[key]; else state.vehicle[key] = v; };
      set.reference = true;
      slider(box, s, () => key in state.vehicle ? state.vehicle[key] : start, set);
    }
  }

  // undo

  const snapshot = () => JSON.stringify({ edits: state.edits, vehicle: state.vehicle });
  const buttons = () => {
    get("undo").disabled = !past.length;
    get("redo").disabled = !ahead.length;
    get("opened").disabled = !Object.keys(state.edits).length;
  };
  function remember(before) {
    if (before === snapshot()) return;
    past.push(before);
    ahead = [];
    buttons();
  }
  function back(from, to) {
    if (!from.length) return;
    const vehicle = JSON.stringify(state.vehicle);
    to.push(snapshot());
    Object.assign(state, JSON.parse(from.pop()));
    inputs.forEach((show) => show());
    buttons();
    follow(vehicle !== JSON.stringify(state.vehicle));
  }
  get("undo").addEventListener("click", () => back(past, ahead));
  get("redo").addEventListener("click", () => back(ahead, past));
  get("opened").addEventListener("click", () => { const was = snapshot(); state.edits = {}; remember(was); inputs.forEach((show) => show()); buttons(); follow(); });
  addEventListener("keydown", (event) => {
    if (!(event.ctrlKey || event.metaKey) || event.target.type === "text") return;
    const key = event.key.toLowerCase();
    if (key === "z" && !event.shiftKey) { event.preventDefault(); back(past, ahead); }
    if (key === "y" || (key === "z" && event.shiftKey)) { event.preventDefault(); back(ahead, past); }
  });

  // choice of the operating point, and saving

  const options = { point: setting.points.map((p, k) => [k, p.label]), plane: setting.planes.map((p) => [p, p]), kind: setting.kinds.map((k) => [k, k]) };
  for (const [id, every] of Object.entries(options)) {
    for (const [key, text] of every) make(get(id), "option", text, { value: key });
    get(id).value = state[id];
    get(id).parentNode.hidden = every.length < 2;
    get(id).addEventListener("change", () => {
      const was = stage();
      state[id] = id === "point" ? +get(id).value : get(id).value;
      if (was !== stage()) sliders(); else inputs.forEach((show) => show());
      follow(true);
    });
  }
  get("name").value = setting.saves_as;
  get("save").addEventListener("submit", async (event) => {
    event.preventDefault();
    try { say(`saved ${(await ask("save", { edits: state.edits, name: get("name").value })).saved}`); } catch (problem) { say(problem.message, true); }
  });
  sliders();
  draw(read("shown").trial);
})();
