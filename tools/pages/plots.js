// Draws the figures of a page from the data in it (tools/plots/figures.py says what they hold): hover for values, drag
// to zoom, double click to see all, click a point for the command that flies it. With the keyboard: left and right go
// along a curve, up and down to another one, + and - zoom, Escape shows all, Enter gives the command. Panels that share
// a time or frequency axis zoom together. Redrawn when the page's width changes.
"use strict";
(() => {
  const SVG = "http://www.w3.org/2000/svg", LETTER = 6.1, FONT = 10.5;
  const M_DB = [-20, -12, -6, -3, -1, 0.5, 1, 3, 6, 12], N_DEG = [10, 30, 60, 90, 120, 150, 210, 240, 270, 300, 330, 350];
  const KEYS = "arrow keys read values along a curve and of the next curve, + and - zoom, Escape shows all";
  const RADII = [9, 15, 23, 34, 48, 66], ANGLES = [...Array(12).keys()].map((k) => k * Math.PI / 6);

  const make = (parent, tag, text = "", attributes = {}) => {
    const it = parent.namespaceURI === SVG || tag === "svg" ? document.createElementNS(SVG, tag) : document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) it.setAttribute(name, value);
    it.textContent = text;
    return parent.appendChild(it);
  };
  const colour = (name) => `var(--${name})`;
  const finite = (values) => values.filter((v) => v !== null && isFinite(v));
  const shown = (value, digits = 4) => {
    const size = Math.abs(value);
    if (value === 0 || !isFinite(value)) return String(value);
    return size >= 1e7 || size < 1e-4 ? value.toExponential(digits - 1) : String(+value.toPrecision(digits));
  };
  const grouped = (text) => text.replace(/^(-?\d+)(?=\d{3}$)/, (whole) => whole.length > 1 ? whole + "\u202f" : whole);

  // the open loop L in its planes: frequency (x, Hz), |L| (y, dB) and phase without jumps (y2, deg)

  const turned = (deg) => deg - 360 * Math.ceil(deg / 360);
  const vector = (db, deg) => [Math.cos, Math.sin].map((f) => 10 ** (db / 20) * f(deg * Math.PI / 180));
  const distance = (db, deg) => { const [re, im] = vector(db, deg); return Math.hypot(1 + re, im); };
  const drawnIn = (size) => size > 1 ? 1 + Math.log(size) : size; // Nyquist: radius true up to 1, logarithmic beyond
  const PLANES = {
    gain: (hz, db) => [hz, db],
    phase: (hz, db, deg) => [hz, deg],
    distance: (hz, db, deg) => [hz, distance(db, deg)],
    nichols: (hz, db, deg) => [turned(deg), db],
    nyquist: (hz, db, deg) => vector(20 * Math.log10(drawnIn(10 ** (db / 20))), deg),
    critical: (hz, db, deg) => vector(db, deg),
  };

  function inPlane(plane, s) {
    const to = PLANES[plane], curve = { kind: "line", colour: s.colour || "blue", dash: s.dash, name: s.label || "L", x: [], y: [], index: [] };
    curve.read = (i, k = curve.index[i]) => `${shown(s.x[k], 3)} Hz\n|L| ${s.y[k].toFixed(1)} dB, phase ${s.y2[k].toFixed(0)} deg\n|1 + L| ${shown(distance(s.y[k], s.y2[k]), 3)}`;
    const add = (x, y, k) => { curve.x.push(x); curve.y.push(y); curve.index.push(k); };
    s.x.forEach((hz, k) => {
      const [x, y] = to(hz, s.y[k], s.y2[k]);
      if (plane === "nichols" && k && Math.abs(x - curve.x[curve.x.length - 1]) > 180) add(null, null, null);
      add(x, y, k);
    });
    const out = [], red = (px, name) => {
      out.push({ kind: "line", colour: "limit", width: 3, name: "margin", faint: true, live: s.live, x: px.map((p) => p[0]), y: px.map((p) => p[1]) });
      out.push({ kind: "points", colour: "limit", name: "", live: s.live, x: [px[0][0]], y: [px[0][1]], labels: [name], read: () => name });
    };
    if (s.under) return [curve]; // below another loop, which has marks and limits
    curve.live = s.live;
    if (plane === "gain") out.push({ kind: "limit", colour: "grey", name: "0 dB", value: 0, seen: true });
    if (plane === "phase") for (let k = -12; k < 4; k++) out.push({ kind: "limit", colour: "grey", dash: "2 2", name: "-180 deg ± 360 deg", value: 360 * k - 180, seen: false });
    const around = plane === "nyquist" || plane === "critical"; // planes of L itself
    out.push(...(s.limits && s.limits[plane] || []), curve);
    for (const m of s.marks) {
      const p = to(m.x, m.y, m.y2), whole = 360 * Math.round((m.y2 + 180) / 360) - 180, way = [...Array(13).keys()].map((k) => m.y2 + (whole - m.y2) * k / 12);
      const dot = { kind: "points", colour: m.colour, name: "", live: s.live, x: [p[0]], y: [p[1]], labels: [plane === "phase" ? "" : m.name], read: () => `${m.name}\n${shown(m.x, 3)} Hz, ${m.y.toFixed(1)} dB` };
      if (m.what === "lobe" && plane !== "distance") out.push(dot);
      else if (m.what === "least" && plane === "distance") out.push({ ...dot, colour: "limit" });
      else if (m.what === "least" && plane === "critical") red([p, [-1, 0]], `|1 + L| ${m.name}`);
      else if (m.what === "gain" && plane !== "phase" && plane !== "distance") red([p, around ? [-1, 0] : [p[0], 0]], m.name);
      else if (m.what === "phase" && plane === "phase") red([p, [p[0], whole]], m.name);
      else if (m.what === "phase" && (plane === "nichols" || around)) red(way.map((deg) => plane === "nichols" ? [p[0] + deg - m.y2, 0] : to(m.x, 0, deg)), m.name);
    }
    if (plane === "nichols" || around) out.push({ kind: "points", colour: "ink", mark: "+", name: "-1", x: [around ? -1 : -180], y: [0] });
    return out;
  }

  // axes

  function range(series, key, given, log) {
    let values = [];
    for (const s of series) {
      if (s.kind === "limit" && !s.seen) continue;
      if (s.kind === "limit" || s.kind === "at") { if ((s.kind === "at") === (key === "x")) values.push(s.value); continue; }
      values.push(...(key === "x" && s.edges || s[key]));
      if (key === "y" && s.y2 && s.kind === "band") values.push(...s.y2);
      if (s.kind === "bars" && key === "y") values.push(0);
    }
    values = finite(values).filter((v) => !log || v > 0);
    let low = Infinity, high = -Infinity;
    for (const v of values) { low = Math.min(low, v); high = Math.max(high, v); }
    if (!values.length) [low, high] = [0, 1];
    const [f, g] = log ? [Math.log10, (v) => 10 ** v] : [(v) => v, (v) => v];
    const room = key === "y" ? 0.06 * (f(high) - f(low) || Math.abs(f(high)) || 1) : 0.01 * (f(high) - f(low) || 1);
    const bars = series.some((s) => s.kind === "bars") && key === "y";
    const found = [bars ? 0 : g(f(low) - room), g(f(high) + room)];
    return found.map((v, k) => given && given[k] !== null ? given[k] : v);
  }

  function ticks(low, high, log, pixels, wide, least = 0) {
    if (log && high / low > 8) {
      const decade = pixels / Math.log10(high / low), every = Math.ceil((wide ? 46 : 18) / decade);
      const at = (steps) => {
        const out = [];
        for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k += every)
          for (const m of steps) if (m * 10 ** k >= low * 0.999 && m * 10 ** k <= high * 1.001) out.push(m * 10 ** k);
        return out;
      };
      const out = decade > (wide ? 130 : 60) ? at([1, 2, 5]) : at([1]);
      return out.map((v) => [v, v >= 1e5 || v < 1e-3 ? v.toExponential(0) : String(+v.toPrecision(3))]);
    }
    const most = Math.max(Math.floor(pixels / (wide ? 60 : 26)), 1);
    for (let count = most, more = 1; ; count--) {
      const rough = (high - low) / count, size = 10 ** Math.floor(Math.log10(rough));
      let step = [1, 2, 2.5, 5, 10].map((m) => m * size).find((s) => s >= rough * 0.999 && (!least || (s >= least && Number.isInteger(s)))) || least;
      if (high - low > 150 && Math.abs(low % 90) < 1e-6 && Math.abs(high % 90) < 1e-6) step = [30, 45, 60, 90, 180, 360, 720].find((s) => s >= rough) || step;
      const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9) + (String(step / 10 ** Math.floor(Math.log10(step) + 1e-9)).startsWith("2.5") ? 1 : 0));
      const out = [];
      for (let k = Math.ceil(low / step - 1e-6); k <= high / step + 1e-6; k++) {
        const v = k * step;
        out.push([v, Math.max(Math.abs(low), Math.abs(high)) >= 1e7 ? v.toExponential(1) : grouped((Math.abs(v) < step / 2 ? 0 : v).toFixed(digits))]);
      }
      if (out.length < 2 && more < 8) { count = most + more++ + 1; continue; } // a single tick gives no scale
      const room = wide ? out.reduce((most, [, text]) => Math.max(most, text.length), 0) * LETTER + 10 : 0;
      if (count <= 1 || out.length < 2 || room < pixels * step / (high - low)) return out;
    }
  }

  // a panel

  const whole = (panel) => panel.series.some((s) => s.kind === "bars") ? 1 : 0; // counts have no fractions
  const bare = (panel) => panel.rows || panel.plane === "nyquist"; // no scale at the left
  const roomLeft = (panel, view, height) => bare(panel) ? 8 : 10 + LETTER * Math.max(2, ...ticks(...view.y, panel.log_y, height - 30, false, whole(panel)).map(([, text]) => text.length));

  function draw(frame, panel, series, view, height, left, wide) {
    frame.replaceChildren();
    const width = Math.max(wide, 180);
    const box = { top: 6, right: 12, bottom: 20, left };
    let [xs, ys] = [view.x, view.y];
    const w = width - box.left - box.right, needed = (ys[1] - ys[0]) / (xs[1] - xs[0]) * w + box.top + box.bottom + 52; // and names above and below
    if (panel.equal && !panel.plane) height = Math.min(height, Math.max(needed, 90)); // to scale, without empty space
    const h = height - box.top - box.bottom;
    if (panel.equal) {
      const unit = Math.max((xs[1] - xs[0]) / w, (ys[1] - ys[0]) / h);
      [xs, ys] = [[xs, w], [ys, h]].map(([[a, b], pixels]) => [(a + b - unit * pixels) / 2, (a + b + unit * pixels) / 2]);
    }
    const up = ticks(...ys, panel.log_y, height - 30, false, whole(panel));
    const rows = bare(panel);
    const scale = (log, [low, high]) => log ? (v) => Math.log(v / low) / Math.log(high / low) : (v) => (v - low) / (high - low);
    const fx = scale(panel.log_x, xs), fy = scale(panel.log_y, ys);
    const X = (v) => box.left + w * fx(v), Y = (v) => box.top + h * (panel.down ? fy(v) : 1 - fy(v));
    const svg = make(frame, "svg", "", { viewBox: `0 0 ${width} ${height}`, role: "img", tabindex: 0, "aria-label": [panel.title, panel.y, panel.x && `over ${panel.x}`].filter(Boolean).join(", "), "aria-description": KEYS });
    const id = "c" + (draw.count = (draw.count || 0) + 1);
    make(make(make(svg, "defs"), "clipPath", "", { id }), "rect", "", { x: box.left, y: box.top, width: w, height: h });
    const line = (parent, x1, y1, x2, y2, name, more = {}) => make(parent, "line", "", { x1, y1, x2, y2, style: `stroke:${colour(name)}`, ...more });
    const texts = [];
    const write = (x, y, text, anchor, name = "dim", more = {}) => {
      texts.push({ x0: x - text.length * LETTER * { start: 0, middle: 0.5, end: 1 }[anchor], y0: y - 8, x1: x + text.length * LETTER * { start: 1, middle: 0.5, end: 0 }[anchor], y1: y + 2 });
      return make(svg, "text", text, { x, y, "text-anchor": anchor, "font-size": FONT, style: `fill:${colour(name)}`, ...more });
    };
    const along = panel.plane === "nyquist" ? [] : ticks(...xs, panel.log_x, w, true);
    if (panel.log_x && xs[1] / xs[0] > 8 && w / Math.log10(xs[1] / xs[0]) > 60)
      for (let k = Math.floor(Math.log10(xs[0])); k <= Math.log10(xs[1]); k++)
        for (let m = 2; m < 10; m++) if (m * 10 ** k > xs[0] && m * 10 ** k < xs[1]) line(svg, X(m * 10 ** k), box.top, X(m * 10 ** k), box.top + h, "line", { opacity: 0.45 });
    for (const [v, text] of along) {
      line(svg, X(v), box.top, X(v), box.top + h, "line");
      const half = text.length * LETTER / 2;
      write(Math.min(Math.max(X(v), half), width - half), height - 5, text, "middle");
    }
    if (!rows) for (const [v, text] of up) {
      line(svg, box.left, Y(v), box.left + w, Y(v), "line");
      write(box.left - 5, Math.min(Math.max(Y(v) + 3.5, 9), box.top + h + 3), text, "end");
    }
    const inside = make(svg, "g", "", { "clip-path": `url(#${id})` });
    const points = [], obstacles = [], names = [], solids = [];
    const path = (px, closed = false) => {
      let out = "", pen = false;
      for (const [x, y] of px) {
        if (!isFinite(x) || !isFinite(y)) { pen = false; continue; }
        out += (pen ? "L" : "M") + x.toFixed(1) + " " + Math.max(-9999, Math.min(9999, y)).toFixed(1);
        pen = true;
      }
      return out + (closed ? "Z" : "");
    };
    const place = (s, k, y = s.y) => [s.x[k] === null ? NaN : X(s.x[k]), y[k] === null ? NaN : Y(y[k])];
    const cover = (px) => {
      for (let k = 0; k < px.length; k++) {
        const [a, b] = [px[Math.max(k - 1, 0)], px[k]];
        const n = isFinite(a[0] + a[1] + b[0] + b[1]) ? Math.min(Math.ceil(Math.hypot(b[0] - a[0], b[1] - a[1]) / 4), 200) || 1 : 0;
        for (let i = 1; i <= n; i++) obstacles.push([a[0] + (b[0] - a[0]) * i / n, a[1] + (b[1] - a[1]) * i / n]);
      }
    };
    const mapped = (x, y, text) => names.push({ x, y, name: text, colour: "dim", size: 9 });
    if (panel.plane === "nichols") contours(inside, X, Y, path, ys, mapped, panel, [xs, ys, box.left, w, h].join());
    if (panel.plane === "nyquist") rings(inside, X, Y, mapped, [-6, 0, 10, 20, 30, 40, 60]);
    if (panel.plane === "critical") rings(inside, X, Y, mapped, [-6, 0]);
    const put = (some, inside) => { for (const s of some) {
      const look = `stroke:${colour(s.colour)};stroke-width:${s.width || 1.5};` + (s.dash ? `stroke-dasharray:${s.dash};` : "");
      const px = s.x ? s.x.map((_, k) => place(s, k)) : [];
      if (s.kind === "band" || s.kind === "shape") {
        const back = s.kind === "band" ? s.x.map((_, k) => place(s, k, s.y2)).reverse() : [];
        const border = s.kind === "shape" && !s.bare ? look : "stroke:none;";
        make(inside, "path", "", { d: path([...px, ...back].filter((p) => isFinite(p[0] + p[1])), true), style: `${border}fill:${colour(s.fill || s.colour)};fill-opacity:${s.opacity || 0.2}` });
        if (s.solid) solids.push({ x0: Math.min(...px.map((p) => p[0])), x1: Math.max(...px.map((p) => p[0])), y0: Math.min(...px.map((p) => p[1])), y1: Math.max(...px.map((p) => p[1])) });
        if (s.kind === "shape") { if (!s.bare) cover([...px, px[0]]); continue; }
      } else if (s.kind === "line") {
        make(inside, "path", "", { d: path(px), style: look + "fill:none" });
        if (!s.faint || s.width > 2) cover(px);
      } else if (s.kind === "bars") {
        const base = Y(Math.max(ys[0], 0));
        s.y.forEach((count, k) => {
          const [a, b] = [X(s.edges[k]), X(s.edges[k + 1])], missed = s.y2 ? s.y2[k] : 0;
          const bar = (n, name, y1) => n && make(inside, "rect", "", { x: a + 0.5, y: Y(y1), width: Math.max(b - a - 1, 0.7), height: base - Y(n), style: `fill:${colour(name)}` });
          bar(count, s.colour, count);
          bar(missed, "limit", missed);
        });
      } else if (s.kind === "rows") {
        const step = h / s.y.length;
        s.y.forEach((value, k) => {
          const y = box.top + step * (k + 0.5), thick = Math.min(0.55 * step, 14), side = value < 0 ? 1 : -1; // the name is on the side without the bar
          make(inside, "rect", "", { x: Math.min(X(0), X(value)), y: y - thick / 2, width: Math.abs(X(value) - X(0)), height: thick, style: `fill:${colour(s.matters[k] ? s.colour : "grey")}` });
          const most = Math.floor((side < 0 ? X(0) - box.left : box.left + w - X(0)) / LETTER) - 1, name = s.names[k];
          write(X(0) + 5 * side, y + 3.5, name.length > most ? name.slice(0, most - 1) + "…" : name, side < 0 ? "end" : "start", "ink");
          points.push({ x: X(value), y, s, k });
        });
        continue;
      } else if (s.kind === "limit" || s.kind === "at") {
        const at = s.kind === "limit" ? Y(s.value) : X(s.value);
        if (s.kind === "limit") line(inside, box.left, at, box.left + w, at, s.colour, { style: look });
        else line(inside, at, box.top, at, box.top + h, s.colour, { style: look });
        cover(s.kind === "limit" ? [[box.left, at], [box.left + w, at]] : [[at, box.top], [at, box.top + h]]);
        continue;
      }
      if (s.kind === "points" || s.mark) for (const [k, p] of px.entries()) {
        if (!isFinite(p[0] + p[1])) continue;
        const r = s.size || (s.mark ? 2.2 : 2.6);
        if (s.mark === "x") make(inside, "path", "", { d: `M${p[0] - 4} ${p[1] - 4}l8 8m0 -8l-8 8`, style: `stroke:${colour(s.colour)};stroke-width:1.8` });
        else if (s.mark === "+") make(inside, "path", "", { d: `M${p[0] - 6} ${p[1]}h12m-6 -6v12`, style: `stroke:${colour(s.colour)};stroke-width:1.8` });
        else make(inside, "circle", "", { cx: p[0], cy: p[1], r, style: `fill:${s.hollow && s.hollow[k] ? "var(--page)" : colour(s.colour)};stroke:${colour(s.colour)};fill-opacity:${s.opacity || 1};stroke-width:${s.hollow ? 1.2 : 0}` });
        if (s.mark || s.labels) texts.push({ x0: p[0] - 4 - 3 * (s.mark === "+"), x1: p[0] + 4 + 3 * (s.mark === "+"), y0: p[1] - 4 - 3 * (s.mark === "+"), y1: p[1] + 4 + 3 * (s.mark === "+") });
        if (s.labels && s.labels[k]) names.push({ x: p[0], y: p[1], name: s.labels[k], colour: s.colour, must: true });
      }
      px.forEach(([x, y], k) => { if (!s.faint && isFinite(x + y)) points.push({ x, y: s.kind === "bars" ? Math.min(y, box.top + h - 4) : y, s, k }); });
    } };
    put(series.filter((s) => !s.live), inside);
    const layer = make(inside, "g"), fixed = points.length, still = [...names], before = texts.length;
    put(series.filter((s) => s.live), layer);
    if (panel.plane !== "nyquist") line(svg, box.left, box.top + h, box.left + w, box.top + h, "dim");
    if (!rows) line(svg, box.left, box.top, box.left, box.top + h, "dim");
    for (const s of series) if (s.kind === "limit" && s.note && s.value >= ys[0] && s.value <= ys[1])
      names.push({ x: box.left + w - s.note.length * LETTER / 2, y: Y(s.value), name: s.note, colour: s.colour, must: true, near: true });
    const frameBox = { x0: box.left, y0: box.top, x1: box.left + w, y1: box.top + h }, named = make(svg, "g");
    label(named, names, texts, obstacles, solids, frameBox);
    const refresh = (some) => { // only the live series, on the same axes; their names may cover curves
      points.length = fixed;
      names.splice(0, names.length, ...still);
      obstacles.length = 0;
      texts.length = before;
      layer.replaceChildren();
      named.replaceChildren();
      put(some.filter((s) => s.live), layer);
      label(named, names, texts, [], solids, frameBox);
    };
    return { svg, points, refresh, box, w, h, width, height, back: (p) => {
      const un = (log, [low, high], f) => log ? low * (high / low) ** f : low + f * (high - low);
      const f = (p[1] - box.top) / h;
      return [un(panel.log_x, xs, (p[0] - box.left) / w), un(panel.log_y, ys, panel.down ? f : 1 - f)];
    } };
  }

  // M and N contours: where T = L / (1 + L) has a size, named by it in dB, or a phase. From L = T / (1 - T).
  function contours(into, X, Y, path, [low, high], name, panel, view) {
    const stroke = (d) => make(into, "path", "", { d, style: `fill:none;stroke:${colour("line")};stroke-width:0.8` });
    if (panel.contours && panel.contours.view === view) { // as drawn before
      panel.contours.paths.forEach(stroke);
      panel.contours.names.forEach((one) => name(...one));
      return;
    }
    const paths = [], named = [];
    Object.defineProperty(panel, "contours", { value: { view, paths, names: named }, configurable: true, enumerable: false });
    const spot = (m, turn) => {
      const [re, im] = [m * Math.cos(turn), m * Math.sin(turn)], d = (1 - re) ** 2 + im * im;
      const [a, b] = [(re * (1 - re) - im * im) / d, im / d];
      let phase = Math.atan2(b, a) * 180 / Math.PI;
      if (phase > 0) phase -= 360;
      return [phase, 20 * Math.log10(Math.hypot(a, b))];
    };
    const trace = (spots) => {
      const px = [];
      spots.forEach(([x, y], k) => {
        if (k && Math.abs(x - spots[k - 1][0]) > 180) px.push([NaN, NaN]);
        px.push([X(x), Y(y)]);
      });
      paths.push(path(px));
      stroke(paths[paths.length - 1]);
    };
    for (const db of M_DB) {
      const m = 10 ** (db / 20), spots = [...Array(361).keys()].map((k) => spot(m, (-359.9 + k * 359.8 / 360) * Math.PI / 180));
      trace(spots);
      const seen = spots.filter(([x, y]) => y > low && y < high && x > -340);
      if (seen.length && db < 12) { // the innermost lies on -1
        const best = seen.reduce((a, b) => (db < 0 ? b[0] > a[0] : b[1] > a[1]) ? b : a);
        named.push([X(best[0]), Y(best[1]), `${db} dB`]);
        name(...named[named.length - 1]);
      }
    }
    for (const deg of N_DEG) trace([...Array(161).keys()].map((k) => spot(10 ** ((-70 + k * 130 / 160) / 20), -deg * Math.PI / 180)));
  }

  // Circles of |L| around the origin of the Nyquist plane, named in dB.
  function rings(into, X, Y, name, levels) {
    for (const db of levels) {
      const r = drawnIn(10 ** (db / 20));
      make(into, "circle", "", { cx: X(0), cy: Y(0), r: X(r) - X(0), style: `fill:none;stroke:${colour(db ? "line" : "grey")};stroke-width:0.8` });
      name(X(0), Y(r), `${db} dB`);
    }
  }

  // names of points: near the point, over no curve and no other text; what need not stand is left out where there is no room
  function label(svg, names, taken, obstacles, solids, frame) {
    for (const n of [...names].sort((a, b) => (b.must || 0) - (a.must || 0))) {
      if (n.x < frame.x0 || n.x > frame.x1 || n.y < frame.y0 || n.y > frame.y1) continue;
      const size = n.size || 10, half = [n.name.length * size * 0.3 + 2, size * 0.55 + 1];
      const reach = [0, 1].map((axis) => RADII[RADII.length - 1] + 2 * half[axis]);
      const close = obstacles.filter(([x, y]) => Math.abs(x - n.x) < reach[0] && Math.abs(y - n.y) < reach[1]);
      let best = Infinity, found = null;
      for (const radius of RADII) for (const angle of ANGLES) {
        const at = [n.x + (radius + half[0]) * Math.cos(angle) * (n.near ? 0.3 : 1), n.y + (radius + half[1]) * Math.sin(angle)];
        const spot = { x0: at[0] - half[0], y0: at[1] - half[1], x1: at[0] + half[0], y1: at[1] + half[1] };
        let cost = 0.4 * radius;
        for (const t of taken) if (spot.x0 < t.x1 && t.x0 < spot.x1 && spot.y0 < t.y1 && t.y0 < spot.y1) cost += 1e4;
        for (const t of solids) if (spot.x0 < t.x1 && t.x0 < spot.x1 && spot.y0 < t.y1 && t.y0 < spot.y1) cost += 500;
        if (spot.x0 < frame.x0 || spot.y0 < frame.y0 || spot.x1 > frame.x1 || spot.y1 > frame.y1) cost += 1e4;
        if (cost < best) for (const [x, y] of close) if (x > spot.x0 && x < spot.x1 && y > spot.y0 && y < spot.y1) cost += 3;
        if (cost < best) [best, found] = [cost, { ...spot, at, radius }];
      }
      if (!found || (best >= 1e4 && !n.must) || (!n.must && best > 60)) continue;
      taken.push(found);
      if (found.radius > 16 && !n.near) make(svg, "line", "", { x1: n.x, y1: n.y, x2: Math.min(Math.max(n.x, found.x0), found.x1), y2: Math.min(Math.max(n.y, found.y0), found.y1), style: `stroke:${colour(n.colour)};stroke-width:0.6` });
      make(svg, "text", n.name, { x: found.at[0], y: found.at[1] + size * 0.35, "text-anchor": "middle", "font-size": size, class: "halo", style: `fill:${colour(n.must && n.colour !== "limit" ? "ink" : n.colour)}` });
    }
  }

  // hover, zoom, command

  const tip = make(document.body, "div", "", { class: "tip", hidden: "", role: "status" });
  function live(figure, panel, state, note, redraw, follow) {
    const { svg, points, box, w, h } = state;
    let from = null, rect = null;
    const at = (event) => {
      const r = svg.getBoundingClientRect();
      return [(event.clientX - r.left) * state.width / r.width, (event.clientY - r.top) * state.height / r.height];
    };
    const nearest = ([x, y]) => {
      let best = 400, found = null;
      for (const p of points) {
        const d = p.s.kind === "bars" ? (Math.abs(p.x - x) < w * 0.5 / p.s.y.length + 1 ? 0 : 1e9) : (p.x - x) ** 2 + (p.y - y) ** 2;
        if (d < best && p.x >= box.left - 1 && p.x <= box.left + w + 1) [best, found] = [d, p];
      }
      return found;
    };
    const ring = make(svg, "circle", "", { r: 4, class: "ring", visibility: "hidden" });
    const command = ({ s, k }) => s.runs && s.runs[k] !== null ? (figure.command || "").replace("{}", s.runs[k]) : s.commands ? s.commands[k] : s.command || "";
    const say = ({ s, k }) => {
      const what = [s.names ? s.names[k] : s.who || s.labels && s.labels[k] || s.name].filter(Boolean);
      if (s.read) what.push(s.read(k));
      else if (s.kind === "bars") what.push(`${shown(s.edges[k])} to ${shown(s.edges[k + 1])} ${panel.unit || ""}`, `${s.y[k]} runs${s.y2 && s.y2[k] ? `, ${s.y2[k]} miss the limit` : ""}`);
      else if (s.kind === "rows") what.push(`${panel.x}: ${shown(s.y[k])}`);
      else what.push(`${panel.x || "x"}: ${shown(s.x[k])}`, `${panel.y || panel.title}: ${shown(s.y[k])}${s.kind === "band" ? " to " + shown(s.y2[k]) : ""}`);
      if (s.more && s.more[k]) what.push(s.more[k]);
      if (s.runs && s.runs[k] !== null) what.push((s.kind === "bars" ? "worst of them: run " : "run ") + s.runs[k]);
      if (command({ s, k })) what.push("click: the command that flies it");
      return what.join("\n");
    };
    const mark = (found) => {
      ring.setAttribute("visibility", found ? "visible" : "hidden");
      if (found) { ring.setAttribute("cx", found.x); ring.setAttribute("cy", found.y); }
    };
    state.mark = (index) => mark(points.find((p) => p.s.index && p.s.index[p.k] === index));
    const tell = (found, x, y) => {
      tip.hidden = !found;
      mark(found);
      follow(found && found.s.index ? found.s.index[found.k] : null, state);
      if (!found) return;
      tip.textContent = say(found);
      tip.style.left = `${Math.max(x + 14 + tip.offsetWidth > innerWidth ? x - 14 - tip.offsetWidth : x + 14, 2)}px`;
      tip.style.top = `${Math.min(y + 12, innerHeight - tip.offsetHeight - 4)}px`;
    };
    const offer = (found) => {
      const text = found && command(found);
      if (!text) return;
      note.replaceChildren();
      make(note, "code", text);
      const copy = make(note, "button", "copy", { type: "button" });
      copy.addEventListener("click", () => navigator.clipboard.writeText(text).then(() => { copy.textContent = "copied"; }));
      note.hidden = false;
    };
    svg.addEventListener("pointermove", (event) => {
      const p = at(event);
      if (from) {
        const [a, b] = [[Math.min(p[0], from[0]), Math.min(p[1], from[1])], [Math.abs(p[0] - from[0]), Math.abs(p[1] - from[1])]];
        rect = rect || make(svg, "rect", "", { class: "zoom" });
        for (const [name, value] of Object.entries({ x: a[0], y: a[1], width: b[0], height: b[1] })) rect.setAttribute(name, value);
        tip.hidden = true;
        return;
      }
      tell(nearest(p), event.clientX, event.clientY);
    });
    svg.addEventListener("pointerleave", () => tell(null));
    svg.addEventListener("pointerdown", (event) => { from = at(event); });
    svg.addEventListener("pointercancel", () => { from = null; if (rect) rect.remove(); rect = null; });
    svg.addEventListener("pointerup", (event) => {
      const to = at(event), start = from;
      from = null;
      if (rect) rect.remove();
      rect = null;
      if (start && Math.abs(to[0] - start[0]) > 8 && Math.abs(to[1] - start[1]) > 8 && !panel.rows) {
        const clip = (p) => [Math.min(Math.max(p[0], box.left), box.left + w), Math.min(Math.max(p[1], box.top), box.top + h)];
        const [a, b] = [state.back(clip(start)), state.back(clip(to))];
        redraw({ x: [Math.min(a[0], b[0]), Math.max(a[0], b[0])], y: [Math.min(a[1], b[1]), Math.max(a[1], b[1])] });
        return;
      }
      offer(nearest(to));
    });
    const along = [...new Set(points.map((p) => p.s))].map((one) => points.filter((p) => p.s === one));
    let [row, place] = state.cursor || [0, -1];
    svg.addEventListener("keydown", (event) => {
      const step = { ArrowRight: [0, 1], ArrowLeft: [0, -1], ArrowDown: [1, 0], ArrowUp: [-1, 0] }[event.key];
      const zoom = { "+": 0.6, "=": 0.6, "-": 1 / 0.6 }[event.key];
      if (!step && !zoom && event.key !== "Escape" && event.key !== "Enter") return;
      event.preventDefault();
      if (event.key === "Escape") { tell(null); redraw(null); return; }
      if (!along.length) return;
      const x = (along[row][place] || {}).x;
      row = (row + (step ? step[0] : 0) + along.length) % along.length;
      const mine = along[row], last = mine.length - 1;
      if (step && step[0] && x !== undefined) place = mine.reduce((best, p, k) => Math.abs(p.x - x) < Math.abs(mine[best].x - x) ? k : best, 0);
      else place = Math.min(Math.max(place + (step ? step[1] * (event.shiftKey ? 10 : 1) : 0), 0), last);
      const now = mine[place], r = svg.getBoundingClientRect();
      if (zoom && !panel.rows) {
        const [a, b] = [state.back([now.x - zoom * (now.x - box.left), now.y - zoom * (now.y - box.top)]), state.back([now.x + zoom * (box.left + w - now.x), now.y + zoom * (box.top + h - now.y)])];
        redraw({ x: [Math.min(a[0], b[0]), Math.max(a[0], b[0])], y: [Math.min(a[1], b[1]), Math.max(a[1], b[1])] }, [row, place]);
      } else tell(now, r.left + now.x * r.width / state.width, r.top + now.y * r.height / state.height);
      if (event.key === "Enter") offer(now);
    });
    svg.addEventListener("blur", () => tell(null));
    svg.addEventListener("dblclick", () => redraw(null));
  }

  // figures

  function csv(figure) {
    const cell = (v) => v === null || v === undefined ? "" : /[",\n]/.test(v) ? `"${String(v).replaceAll('"', '""')}"` : v;
    const rows = [["panel", "series", "x", "y", "y2", "run"]];
    for (const p of figure.panels) for (const s of p.series) {
      if (s.kind === "limit" || s.kind === "at") rows.push([p.title, s.name, s.kind === "at" ? s.value : "", s.kind === "at" ? "" : s.value, "", ""]);
      else s.y.forEach((y, k) => rows.push([p.title, s.names ? s.names[k] : s.who || s.name, s.x ? s.x[k] : "", y, s.y2 ? s.y2[k] : "", s.runs ? s.runs[k] : ""]));
    }
    for (const s of figure.loops) s.x.forEach((x, k) => rows.push([s.name, "L: x Hz, y dB, y2 deg", x, s.y[k], s.y2[k], ""]));
    return rows.map((row) => row.map(cell).join(",")).join("\r\n");
  }

  const seriesOf = (panel, loop) => [...panel.series, ...(loop && panel.plane ? [loop] : [])].flatMap((s) => s.kind === "loop" ? inPlane(panel.plane, s) : [s]);

  // one key for a figure, or one for each panel where a look means several things, or panels share no name
  function keys(parent, figure, cells) {
    const named = (panel) => seriesOf(panel, figure.loops[0]).filter((s) => s.name && s.kind !== "rows");
    const look = (s) => [s.kind, s.colour, s.dash, s.width, s.opacity, s.mark, s.fill].join(), meant = new Map(), have = figure.panels.map(named).filter((some) => some.length);
    const apart = have.some((some) => some.some((s) => (meant.has(look(s)) ? meant : meant.set(look(s), s.name)).get(look(s)) !== s.name))
      || have.some((some) => have.some((other) => other !== some && !some.some((s) => other.some((t) => t.name === s.name))));
    if (apart && cells.length > 1 && !figure.loops.length) cells.forEach((c) => key(c.cell, [c.panel], figure));
    else key(parent, figure.panels, figure);
  }

  function key(parent, panels, figure) {
    const seen = new Map();
    for (const p of panels) for (const s of seriesOf(p, figure.loops[0])) if (s.name && !seen.has(s.name) && s.kind !== "rows") seen.set(s.name, s);
    if (panels.some((p) => p.series.some((s) => s.kind === "bars" && s.y2 && s.y2.some((n) => n)))) seen.set("runs that miss the limit", { kind: "bars", colour: "limit" });
    if (seen.size < 1 || panels.every((p) => seriesOf(p, figure.loops[0]).length < 2)) return;
    const list = make(parent, "p", "", { class: "key" });
    for (const [name, s] of seen) {
      const item = make(list, "span"), svg = make(item, "svg", "", { viewBox: "0 0 26 10", width: 26, height: 10 });
      const fill = s.kind === "band" || s.kind === "shape" || s.kind === "bars";
      if (fill) make(svg, "rect", "", { x: 1, y: 1, width: 24, height: 8, style: `fill:${colour(s.fill || s.colour)};fill-opacity:${s.kind === "bars" ? 1 : Math.max(s.opacity || 0.2, 0.2)}` });
      else if (s.kind !== "points") make(svg, "line", "", { x1: 0, y1: 5, x2: 26, y2: 5, style: `stroke:${colour(s.colour)};stroke-width:${s.width || 1.5};stroke-dasharray:${s.dash || "none"}` });
      if (s.mark === "x") make(svg, "path", "", { d: "M9 1l8 8m0 -8l-8 8", style: `stroke:${colour(s.colour)};stroke-width:1.8` });
      else if (s.mark === "+") make(svg, "path", "", { d: "M8 5h10m-5 -5v10", style: `stroke:${colour(s.colour)};stroke-width:1.8` });
      else if (s.kind === "points" || s.mark) make(svg, "circle", "", { cx: 13, cy: 5, r: 3, style: `fill:${colour(s.colour)}` });
      make(item, "span", " " + name);
    }
  }

  // a slider over the open loops of a figure, and a choice of their group
  function chooser(parent, figure, choose) {
    const bar = make(parent, "p", "", { class: "choose" }), groups = [...new Set(figure.loops.map((s) => s.group))];
    let now = Math.max(figure.loops.findIndex((s) => s.first), 0);
    const slide = make(make(bar, "label", "operating point "), "input", "", { type: "range", min: 0, step: 1 });
    const pick = groups.length > 1 && make(make(bar, "label", "plane "), "select");
    for (const name of groups) if (pick) make(pick, "option", name);
    const said = make(bar, "output");
    const show = (wanted) => {
      now = wanted;
      const mine = figure.loops.filter((s) => s.group === figure.loops[now].group);
      slide.max = mine.length - 1;
      slide.parentNode.hidden = mine.length < 2;
      slide.value = mine.indexOf(figure.loops[now]);
      slide.setAttribute("aria-valuetext", figure.loops[now].name);
      if (pick) pick.value = figure.loops[now].group;
      said.replaceChildren();
      make(said, "b", figure.loops[now].name);
      make(said, "span", ` ${figure.loops[now].text}`);
      choose(figure.loops[now]);
    };
    slide.addEventListener("input", () => show(figure.loops.indexOf(figure.loops.filter((s) => s.group === figure.loops[now].group)[+slide.value])));
    if (pick) pick.addEventListener("change", () => {
      const near = (s) => s.group === pick.value ? Math.abs(s.at - figure.loops[now].at) : Infinity;
      show(figure.loops.reduce((best, s, k) => near(s) < near(figure.loops[best]) ? k : best, figure.loops.findIndex((s) => s.group === pick.value)));
    });
    show(now);
  }

  const redraws = [], fresh = {};
  // draws other data in the panels of a figure; a zoomed panel remains so. `quick` draws only live series, on the same axes
  globalThis.maxqFigures = { update: (figure) => fresh[figure.name](figure) };
  for (const figure of JSON.parse(document.getElementById("figures").textContent)) {
    const frame = document.getElementById("figure-" + figure.name);
    if (!frame) continue;
    const top = make(frame, "div");
    let loop = figure.loops[0];
    const controls = make(frame, "div");
    const grid = make(frame, "div", "", { class: figure.split ? "panels down" : "panels", style: `--columns:${figure.columns}` });
    const columns = figure.split ? [make(grid, "div"), make(grid, "div")] : [];
    const note = make(frame, "p", "", { class: "command", hidden: "" });
    const cells = figure.panels.map((panel, k) => {
      const column = figure.split ? +(k >= figure.split) : k % figure.columns;
      const cell = make(columns[column] || grid, "div", "", { class: "panel" }), head = make(cell, "p", "", { class: "head" });
      make(head, "b", panel.title.replace(/^[a-z](?=[a-z])/, (letter) => letter.toUpperCase())); // not of k_p, q alpha
      if (panel.y) make(head, "span", (panel.title ? " · " : "") + panel.y);
      const reset = make(head, "button", "show all", { type: "button", hidden: "" });
      const inner = make(cell, "div"), under = panel.x ? make(cell, "p", panel.x, { class: "under" }) : null;
      const every = figure.loops.length ? figure.loops.flatMap((s) => seriesOf(panel, s)) : seriesOf(panel);
      const whole = { x: range(every, "x", panel.x_range, panel.log_x), y: range(every, "y", panel.y_range, panel.log_y) };
      const shares = /^(flight )?time|^frequency/.test(panel.x) ? panel.x : null;
      return { cell, panel, column, reset, inner, under, whole, shares, view: whole, height: panel.height || figure.height };
    });
    keys(top, figure, cells);
    const redraw = () => {
      for (const c of cells) [c.needs, c.wide] = [roomLeft(c.panel, c.view, c.height), c.inner.clientWidth]; // before any change, so that the page is laid out once
      for (const c of cells) {
        const focused = c.inner.contains(document.activeElement), left = Math.max(...cells.filter((d) => d.column === c.column && !bare(d.panel)).map((d) => d.needs), bare(c.panel) ? c.needs : 0);
        c.state = draw(c.inner, c.panel, seriesOf(c.panel, loop), c.view, c.height, bare(c.panel) ? c.needs : left, c.wide);
        c.state.cursor = c.cursor;
        c.reset.hidden = c.view === c.whole;
        if (c.under) c.under.style.paddingLeft = `${c.state.box.left - c.state.box.right}px`;
        live(figure, c.panel, c.state, note, (view, cursor) => show(c, view, cursor), (index, own) => cells.forEach((d) => { if (d.state !== own && d.state.mark) d.state.mark(index); }));
        if (focused) c.state.svg.focus();
      }
    };
    const show = (cell, view, cursor) => {
      cell.cursor = cursor;
      for (const c of cells) {
        if (c !== cell && (!c.shares || c.shares !== cell.shares || c.panel.log_x !== cell.panel.log_x)) continue;
        c.view = { x: view ? view.x : c.whole.x, y: c === cell ? (view || c.whole).y : c.view.y };
        if (c.view.x === c.whole.x && c.view.y === c.whole.y) c.view = c.whole;
      }
      redraw();
    };
    for (const c of cells) c.reset.addEventListener("click", () => show(c, null));
    redraws.push(redraw);
    fresh[figure.name] = ({ panels, quick }) => {
      panels.forEach((panel, k) => Object.assign(cells[k].panel, panel));
      if (quick) { cells.forEach((c) => c.state.refresh(seriesOf(c.panel))); return; }
      for (const c of cells) {
        const zoomed = c.view !== c.whole, every = seriesOf(c.panel);
        c.whole = { x: range(every, "x", c.panel.x_range, c.panel.log_x), y: range(every, "y", c.panel.y_range, c.panel.log_y) };
        if (!zoomed) c.view = c.whole;
      }
      redraw();
    };
    if (figure.loops.length) chooser(controls, figure, (chosen) => { loop = chosen; redraw(); });
    else redraw();
    const link = make(frame.querySelector("figcaption") || frame, "a", "data (CSV)", { class: "data", download: `${figure.name}.csv`, href: "#" });
    link.addEventListener("click", () => { link.href = URL.createObjectURL(new Blob([csv(figure)], { type: "text/csv" })); });
    const caption = frame.querySelector("figcaption");
    if (caption) frame.appendChild(caption);
  }
  let width = innerWidth, waiting = 0;
  addEventListener("resize", () => {
    if (innerWidth === width) return;
    width = innerWidth;
    clearTimeout(waiting);
    waiting = setTimeout(() => redraws.forEach((again) => again()), 120);
  });
})();
