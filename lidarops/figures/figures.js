// Draws the figures of a page from the data in it. See browser.py for what the data are.
// A reader drags to zoom, double-clicks to see all, and reads values under the pointer or, with the
// arrow keys, under a cross. Positions are logarithms along logarithmic axes.

const FONT = '13px system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", sans-serif';
const DAY = 86400e3, MINUTE = 60e3, NARROW = 640, LINE = 18, NONE = 65535;
const MINUTES = [1, 2, 5, 10, 15, 30, 60, 120, 180, 360, 720, 1440, 2880, 7200, 14400];
const HINT = "Drag to zoom, double-click to see all; arrow keys read values, + zooms, Escape ends.";
const scheme = matchMedia("(prefers-color-scheme: dark)");
const pen = document.createElement("canvas").getContext("2d");
pen.font = FONT;

const colour = (name) => (COLOURS[name] || COLOURS.ink)[scheme.matches ? 1 : 0];
const along = (axis, value) => (axis.log ? Math.log(value) : value);
const value = (axis, place) => (axis.log ? Math.exp(place) : place);
const textWidth = (text) => Math.max(...text.split("\n").map((line) => pen.measureText(line).width));
const clamp = (number, low, high) => Math.min(Math.max(number, low), high);

// Numbers and ticks ---------------------------------------------------------------------------

function format(number, digits = 4) {
  let text = String(Number(number.toPrecision(digits)));
  const size = Math.abs(number);
  if (size && (size < 1e-4 || size >= 1e5)) {
    const [digit, power] = Number(number.toPrecision(digits)).toExponential().split("e");
    const raised = power.replace("+", "").replace(/./g, (c) => "⁰¹²³⁴⁵⁶⁷⁸⁹⁻"["0123456789-".indexOf(c)]);
    text = `${digit}×10${raised}`.replace(/^1×/, "");
  }
  return text.replace("-", "−");
}

function ticks(axis, [low, high], most) {
  if (axis.time) return timeTicks(low, high, most);
  if (axis.log) return decades(low, high).map((number) => [Math.log(number), format(number)]);
  const rough = Math.abs(high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((part) => part * power).find((size) => size >= rough * 0.999999);
  const decimals = clamp(-Math.floor(Math.log10(step) + 1e-9) + (step / power === 2.5), 0, 12);
  const found = [];
  for (let k = Math.ceil(Math.min(low, high) / step - 1e-9); k * step <= Math.max(low, high) + 1e-9 * step; k++)
    found.push([k * step, decimals > 4 ? format(k * step) : (k * step).toFixed(decimals).replace("-", "−")]);
  return found;
}

function decades(low, high) {
  const [from, to] = [Math.exp(low), Math.exp(high)];
  for (const parts of [[1], [1, 3], [1, 2, 5], [1, 1.5, 2, 3, 4, 5, 7]]) {
    const found = [];
    for (let power = Math.floor(Math.log10(from)); power <= Math.log10(to); power++)
      found.push(...parts.map((part) => part * 10 ** power));
    const inside = found.filter((tick) => tick >= from * 0.999999 && tick <= to * 1.000001);
    if (inside.length >= 3) return inside;
  }
  return [from, to];
}

function timeTicks(low, high, most) {
  const [from, to] = [low * DAY, high * DAY], found = [];
  const step = MINUTES.find((minutes) => (to - from) / (minutes * MINUTE) <= most);
  if (step) {
    for (let at = Math.ceil(from / (step * MINUTE)) * step * MINUTE; at <= to; at += step * MINUTE) found.push(at);
  } else {
    const months = [1, 2, 3, 6, 12, 24, 60, 120].find((count) => (to - from) / (30.4 * DAY * count) <= most) || 240;
    const first = new Date(from), start = first.getUTCFullYear() * 12 + first.getUTCMonth();
    const begin = (month) => Date.UTC(Math.floor(month / 12), month % 12);
    for (let month = Math.ceil(start / months) * months; begin(month) <= to; month += months)
      if (begin(month) >= from) found.push(begin(month));
  }
  const clock = step < 1440 || !found.length;
  let before = "";
  return (found.length ? found : [from]).map((at) => {
    const [day, hour] = new Date(at).toISOString().split("T"), parts = clock ? [hour.slice(0, 5)] : [];
    if (day !== before) parts.push(day);
    before = day;
    return [at / DAY, parts.join("\n")];
  });
}

// Describes a place along an axis, such as "altitude 1.2 km".
function named(axis, place) {
  if (axis.time) return new Date(place * DAY).toISOString().replace("T", " ").slice(0, 19) + " UTC";
  const [, name, unit] = axis.label.match(/^(.*?)(?: \(([^()]*)\))?$/);
  return `${name} ${format(value(axis, place), 3)}${unit ? ` ${unit}` : ""}`;
}

// Data ----------------------------------------------------------------------------------------

async function unpack(spec) {
  const bytes = Uint8Array.from(atob(spec.data), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();
  const positions = ({ n, lo, hi, at }) =>
    Float64Array.from(new Uint16Array(buffer.slice(at, at + 2 * n)), (code) =>
      code === NONE ? NaN : lo + (code / (NONE - 1)) * (hi - lo));
  for (const layer of spec.panels.flatMap((panel) => panel.layers)) {
    for (const [name, array] of Object.entries(layer)) if (array?.hi !== undefined) layer[name] = positions(array);
    if (layer.is === "image") {
      const columns = layer.sides.length / 2;
      layer.left = layer.sides.subarray(0, columns);
      layer.right = layer.sides.subarray(columns);
      layer.rows = layer.edges.length - 1;
      layer.codes = new Uint8Array(buffer, layer.codes, layer.left.length * layer.rows);
    }
  }
  delete spec.data;
  return spec;
}

function codeColours() {
  const anchors = PALETTE.map(rgb), last = anchors.length - 1;
  const codes = [null, rgb(colour("reject")), rgb(colour("negative"))];
  for (let code = FIRST; code < 256; code++) {
    const place = ((code - FIRST) / (255 - FIRST)) * last, k = Math.min(Math.floor(place), last - 1);
    codes.push(anchors[k].map((part, c) => part + (place - k) * (anchors[k + 1][c] - part)));
  }
  return Uint32Array.from(codes, (c) => (c ? (255 << 24) | (c[2] << 16) | (c[1] << 8) | c[0] : 0));
}
const rgb = (text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16));

// Returns the last place of rising values that is not above a value; -1 before the first.
function search(values, wanted) {
  let low = 0, high = values.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] <= wanted) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

// Layers --------------------------------------------------------------------------------------

function style(ctx, words) {
  const parts = words.split(" ");
  ctx.strokeStyle = ctx.fillStyle = colour(parts.find((part) => COLOURS[part]));
  ctx.setLineDash(DASHES[parts.find((part) => DASHES[part])] || []);
  ctx.lineWidth = parts.includes("thick") ? 2.2 : parts.includes("thin") ? 1 : 1.6;
  return parts;
}

const MARKS = {
  o: (c, x, y) => c.arc(x, y, 3, 0, 7),
  s: (c, x, y) => c.rect(x - 3, y - 3, 6, 6),
  "^": (c, x, y) => outline(c, [[x - 3.6, y + 3], [x + 3.6, y + 3], [x, y - 3.4]]),
  D: (c, x, y) => outline(c, [[x, y - 4], [x + 4, y], [x, y + 4], [x - 4, y]]),
  v: (c, x, y) => outline(c, [[x - 5, y - 8], [x + 5, y - 8], [x, y]]),
  x: (c, x, y) => [[-3, 3], [3, -3]].forEach(([a, b]) => (c.moveTo(x + a, y - 3), c.lineTo(x + b, y + 3))),
};
function outline(ctx, points) {
  points.forEach(([x, y], k) => (k ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
  ctx.closePath();
}

function mark(ctx, shape, parts, x, y) {
  ctx.setLineDash([]);
  ctx.lineWidth = 1.2;
  ctx.beginPath();
  MARKS[shape](ctx, x, y);
  if (parts.includes("cloud")) [ctx.fillStyle, ctx.strokeStyle] = ["#fff", "#000"];
  if (!parts.includes("hollow") && shape !== "x") ctx.fill();
  ctx.stroke();
}

function drawCurve(ctx, layer, x, y) {
  const parts = style(ctx, layer.style);
  if (layer.joined) {
    ctx.beginPath();
    let down = false;
    for (let k = 0; k < x.length; k++) {
      const good = isFinite(x[k] + y[k]);
      if (good) ctx[down ? "lineTo" : "moveTo"](x[k], y[k]);
      down = good;
    }
    ctx.stroke();
  }
  if (layer.mark)
    for (let k = 0; k < x.length; k++) if (isFinite(x[k] + y[k])) mark(ctx, layer.mark, parts, x[k], y[k]);
}

function drawBand(ctx, layer, place) {
  const parts = style(ctx, layer.style);
  const ends = (k, side) => place(layer.along[k], side[k]);
  const good = (k) => k < layer.along.length && isFinite(layer.along[k] + layer.low[k] + layer.high[k]);
  ctx.globalAlpha = layer.is === "bars" ? 0.6 : parts.includes("full") ? 1 : parts.includes("wide") ? 0.16 : 0.28;
  ctx.lineWidth = 1;
  ctx.setLineDash([]);
  for (let k = 0; k < layer.along.length; k++) {
    if (!good(k)) continue;
    ctx.beginPath();
    ctx.moveTo(...ends(k, layer.low));
    if (layer.is === "bars") {
      ctx.lineTo(...ends(k, layer.high));
      ctx.stroke();
      continue;
    }
    const first = k;
    while (good(k + 1)) ctx.lineTo(...ends(++k, layer.low));
    for (let back = k; back >= first; back--) ctx.lineTo(...ends(back, layer.high));
    ctx.fill();
    // Opaque areas that touch leave no line between them.
    if (parts.includes("full")) ctx.stroke();
  }
  ctx.globalAlpha = 1;
}

function drawImage(ctx, layer, box, ratio) {
  const width = Math.round(box.width * ratio), height = Math.round(box.height * ratio);
  const columns = new Int32Array(width).fill(-1), colours = codeColours();
  const pixels = new ImageData(width, height), colour32 = new Uint32Array(pixels.data.buffer);
  for (let c = 0; c < layer.left.length; c++) {
    const [a, b] = [layer.left[c], layer.right[c]].map((edge) => Math.round((box.toX(edge) - box.left) * ratio));
    for (let i = Math.max(a, 0); i < Math.min(Math.max(b, a + 1), width); i++) columns[i] = c;
  }
  for (let j = 0; j < height; j++) {
    const row = search(layer.edges, box.fromY(box.top + (j + 0.5) / ratio));
    if (row < 0 || row >= layer.rows) continue;
    for (let i = 0; i < width; i++)
      if (columns[i] >= 0) colour32[j * width + i] = colours[layer.codes[columns[i] * layer.rows + row]];
  }
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [width, height];
  canvas.getContext("2d").putImageData(pixels, 0, 0);
  ctx.drawImage(canvas, box.left, box.top, box.width, box.height);
}

// A figure ------------------------------------------------------------------------------------

class Picture {
  constructor(place) {
    this.place = place;
    this.views = new Map();
    this.cursor = this.start = null;
    this.canvas = Object.assign(document.createElement("canvas"), { tabIndex: 0 });
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", place.dataset.words);
    this.still = document.createElement("canvas");
    // The first figure of a page says how to use all.
    this.hint = place === document.querySelector("div.fig") ? HINT : "";
    this.words = Object.assign(document.createElement("output"), { textContent: this.hint });
    const all = { type: "button", textContent: "Show all", hidden: true, onclick: () => this.zoom(null) };
    this.all = Object.assign(document.createElement("button"), all);
    const tools = Object.assign(document.createElement("p"), { className: "figtools" });
    tools.append(this.words, this.all);
    place.append(this.canvas, tools);
  }

  async begin() {
    this.spec = await unpack(JSON.parse(this.place.querySelector("script").textContent));
    new ResizeObserver(() => this.draw()).observe(this.place);
    scheme.addEventListener("change", () => this.draw());
    const on = (name, act) => this.canvas.addEventListener(name, act);
    on("pointermove", (event) => this.point(event.offsetX, event.offsetY));
    on("pointerleave", () => this.leave());
    on("pointerdown", (event) => {
      this.start = [event.offsetX, event.offsetY];
      this.point(...this.start);
      this.canvas.setPointerCapture(event.pointerId);
    });
    on("pointerup", () => this.select());
    on("pointercancel", () => this.leave());
    on("dblclick", () => this.zoom(null));
    on("keydown", (event) => this.key(event));
    on("blur", () => this.leave());
  }

  range(axis) {
    return this.views.get(key(axis)) || [along(axis, axis.low), along(axis, axis.high)];
  }

  layout(width) {
    const { panels } = this.spec, narrow = width < NARROW, beside = this.spec.beside && !narrow;
    const most = (panel) => Math.max(3, Math.round(panel.height / 45));
    const labels = panels.flatMap((panel) => ticks(panel.y, this.range(panel.y), most(panel)).map(([, text]) => text));
    const left = Math.max(40, ...labels.map(textWidth)) + 34;
    const right = panels.some((panel) => panel.bar) * (narrow ? 84 : 96) || 16;
    const across = beside ? (width - right) / panels.length - left : width - left - right;
    const seen = new Set();
    let bottom = 0;
    this.boxes = panels.map((panel, k) => {
      const box = { panel, width: across, left: left + (beside ? k * (across + left) : 0), most: most(panel) };
      box.legend = this.legend(panel, across, seen);
      box.labelled = beside || k + 1 === panels.length || key(panels[k + 1].x) !== key(panel.x);
      box.top = (beside ? 0 : bottom) + 12 + LINE * box.legend.length;
      const shape = Math.abs((panel.y.high - panel.y.low) / (panel.x.high - panel.x.low));
      box.height = panel.toScale ? clamp(across * shape, 120, 640) : panel.height * (narrow && this.spec.beside ? 0.7 : 1);
      const x = this.range(panel.x), y = this.range(panel.y);
      box.toX = (place) => box.left + ((place - x[0]) / (x[1] - x[0])) * box.width;
      box.toY = (place) => box.top + box.height - ((place - y[0]) / (y[1] - y[0])) * box.height;
      box.fromX = (pixel) => x[0] + ((pixel - box.left) / box.width) * (x[1] - x[0]);
      box.fromY = (pixel) => y[0] + ((box.top + box.height - pixel) / box.height) * (y[1] - y[0]);
      bottom = box.top + box.height + (box.labelled ? (panel.x.time ? 36 : 20) + 24 : 6);
      return box;
    });
    if (beside) for (const box of this.boxes) box.top = Math.max(...this.boxes.map((other) => other.top));
    return Math.max(...this.boxes.map((box) => box.top + box.height + (box.labelled ? (box.panel.x.time ? 60 : 44) : 6)));
  }

  // Returns the lines of a legend, of layers whose label no earlier panel has.
  legend(panel, width, seen) {
    const lines = [];
    let x = width + 1;
    for (const layer of panel.layers) {
      if (!layer.label || seen.has(layer.label)) continue;
      seen.add(layer.label);
      const step = 44 + textWidth(layer.label);
      if (x + step > width) lines.push((x = 0, []));
      lines.at(-1).push([x, layer]);
      x += step;
    }
    return lines;
  }

  draw() {
    const width = Math.round(this.place.clientWidth);
    if (!width) return;
    const height = this.layout(width), ratio = devicePixelRatio || 1;
    for (const canvas of [this.canvas, this.still]) {
      [canvas.width, canvas.height] = [width * ratio, height * ratio];
      canvas.getContext("2d").setTransform(ratio, 0, 0, ratio, 0, 0);
    }
    this.canvas.style.height = `${height}px`;
    const ctx = this.still.getContext("2d");
    ctx.font = FONT;
    for (const box of this.boxes) this.drawPanel(ctx, box, ratio, width);
    this.show();
  }

  drawPanel(ctx, box, ratio, whole) {
    const { panel } = box, bottom = box.top + box.height, right = box.left + box.width;
    const line = (name, ...points) => {
      style(ctx, `${name} thin`);
      ctx.beginPath();
      points.forEach(([x, y], k) => ctx[k % 2 ? "lineTo" : "moveTo"](x, y));
      ctx.stroke();
    };
    const text = (words, x, y, align = "left", name = "soft", turned = false) => {
      ctx.save();
      ctx.translate(x, y);
      if (turned) ctx.rotate(-Math.PI / 2);
      [ctx.fillStyle, ctx.textAlign] = [colour(name), align];
      if (turned) ctx.scale(Math.min(1, (box.height + 40) / textWidth(words)), 1);
      words.split("\n").forEach((part, k) => ctx.fillText(part, 0, 15 * k));
      ctx.restore();
    };
    const across = this.spaced(ticks(panel.x, this.range(panel.x), Math.max(3, Math.round(box.width / 110))), box);
    const up = ticks(panel.y, this.range(panel.y), box.most);
    for (const [place] of across) line("grid", [box.toX(place), box.top], [box.toX(place), bottom]);
    for (const [place] of up) line("grid", [box.left, box.toY(place)], [right, box.toY(place)]);
    ctx.save();
    ctx.beginPath();
    ctx.rect(box.left, box.top, box.width, box.height);
    ctx.clip();
    for (const layer of panel.layers) this.drawLayer(ctx, layer, box, ratio);
    ctx.restore();
    line("soft", [box.left, box.top], [box.left, bottom], [box.left, bottom], [right, bottom]);
    for (const [place, words] of up) text(words, box.left - 7, box.toY(place) + 4, "right", "ink");
    for (const [place, words] of box.labelled ? across : []) {
      line("soft", [box.toX(place), bottom], [box.toX(place), bottom + 4]);
      const half = textWidth(words) / 2;
      text(words, Math.min(box.toX(place), whole - half - 2), bottom + 18, "center", "ink");
    }
    text(panel.y.label, 13 + box.left - this.boxes[0].left, box.top + box.height / 2, "center", "soft", true);
    if (box.labelled) text(panel.x.label, box.left + box.width / 2, bottom + (panel.x.time ? 52 : 36), "center");
    if (panel.bar) this.drawBar(box, text, ctx, whole);
    box.legend.forEach((row, k) => {
      const y = box.top - 8 - LINE * (box.legend.length - 1 - k);
      for (const [x, layer] of row) {
        this.sample(ctx, layer, box.left + 10 + x, y - 4);
        text(layer.label, box.left + 24 + x, y);
      }
    });
  }

  drawBar(box, text, ctx, whole) {
    const { panel } = box, x = box.left + box.width;
    const shown = ctx.createLinearGradient(0, box.top + box.height, 0, box.top);
    PALETTE.forEach((part, k) => shown.addColorStop(k / (PALETTE.length - 1), part));
    ctx.fillStyle = shown;
    ctx.fillRect(x + 12, box.top, 12, box.height);
    const [low, high] = [panel.bar.low, panel.bar.high].map((end) => along(panel.bar, end));
    for (const [place, words] of ticks(panel.bar, [low, high], box.most)) {
      const y = box.top + box.height - ((place - low) / (high - low)) * box.height;
      text(words, x + 28, y + 4, "left", "ink");
    }
    text(panel.bar.label, whole - 4, box.top + box.height / 2, "center", "soft", true);
  }

  drawLayer(ctx, layer, box, ratio) {
    if (layer.is === "image") drawImage(ctx, layer, box, ratio);
    else if (layer.is === "curve") drawCurve(ctx, layer, layer.x.map(box.toX), layer.y.map(box.toY));
    else if (layer.is === "words") {
      style(ctx, "ink");
      layer.texts.forEach((words, k) => {
        const x = box.toX(layer.x[k]), wide = textWidth(words) + 9;
        ctx.fillText(words, x + wide > box.left + box.width ? x - wide : x + 9, box.toY(layer.y[k]) - 7);
      });
    } else {
      const place = layer.upright ? (a, b) => [box.toX(b), box.toY(a)] : (a, b) => [box.toX(a), box.toY(b)];
      drawBand(ctx, layer, place);
    }
  }

  sample(ctx, layer, x, y) {
    if (layer.is === "curve") {
      const ends = layer.joined ? [x - 9, x + 9] : [NaN, NaN];
      drawCurve(ctx, { ...layer, mark: null }, ends, [y, y]);
      if (layer.mark) mark(ctx, layer.mark, style(ctx, layer.style), x, y + 4 * (layer.mark === "v"));
    } else {
      drawBand(ctx, { ...layer, is: "band", along: [x - 9, x + 9], low: [y - 4, y - 4], high: [y + 4, y + 4] }, (a, b) => [a, b]);
    }
  }

  // Leaves out labels that would touch.
  spaced(marks, box) {
    let end = -Infinity;
    return marks.filter(([place, words]) => {
      const half = textWidth(words) / 2 + 5, x = box.toX(place);
      if (x - half < end) return false;
      end = x + half;
      return true;
    });
  }

  // Reading and zooming -----------------------------------------------------------------------

  show() {
    const ctx = this.canvas.getContext("2d"), ratio = devicePixelRatio || 1;
    ctx.clearRect(0, 0, this.canvas.width, this.canvas.height);
    ctx.drawImage(this.still, 0, 0, this.still.width / ratio, this.still.height / ratio);
    const box = this.box;
    if (!this.cursor || !box) return;
    const [x, y] = this.cursor;
    style(ctx, "ink thin");
    ctx.globalAlpha = 0.6;
    ctx.beginPath();
    if (this.start) ctx.rect(...this.start, x - this.start[0], y - this.start[1]);
    else {
      ctx.moveTo(x, box.top), ctx.lineTo(x, box.top + box.height);
      ctx.moveTo(box.left, y), ctx.lineTo(box.left + box.width, y);
    }
    ctx.stroke();
    ctx.globalAlpha = 1;
  }

  point(x, y) {
    const inside = (box) => x >= box.left && x <= box.left + box.width && y >= box.top && y <= box.top + box.height;
    if (!this.start) this.box = this.boxes.find(inside);
    if (!this.box) return this.leave();
    const { left, top, width, height } = this.box;
    this.cursor = [clamp(x, left, left + width), clamp(y, top, top + height)];
    this.words.textContent = this.read(this.box, ...this.cursor);
    this.show();
  }

  leave() {
    this.cursor = this.start = null;
    this.words.textContent = this.hint;
    this.show();
  }

  // Returns the value under a point: of an image, and of the nearest point of a curve. The first and
  // the last colour also stand for what lies beyond the scale.
  read(box, px, py) {
    const { panel } = box, x = box.fromX(px), y = box.fromY(py), found = [];
    for (const layer of panel.layers.filter((one) => one.is === "image")) {
      const column = search(layer.left, x), row = search(layer.edges, y);
      if (column < 0 || x > layer.right[column] || row < 0 || row >= layer.rows) continue;
      const code = layer.codes[column * layer.rows + row];
      const states = ["no value", "not to use", "at or below 0"];
      found.push(`${named(panel.x, x)}, ${named(panel.y, y)}: ${states[code] || this.coded(panel, code)}`);
    }
    let nearest = Infinity, words = "";
    panel.layers.forEach((layer, k) => {
      if (layer.is !== "curve" || (layer.x.length < 3 && !layer.label)) return;
      for (let i = 0; i < layer.x.length; i++) {
        const at = [box.toX(layer.x[i]), box.toY(layer.y[i])];
        const distance = (at[0] - px) ** 2 + (at[1] - py) ** 2;
        // What lies outside is drawn to the edge, and is not read.
        if (!(distance < nearest) || !within(box, ...at)) continue;
        nearest = distance;
        const error = this.error(panel, k, i), upright = panel.layers[k - 1]?.upright;
        const part = error ? ` ± ${format(error, 2)}` : "";
        words = `${layer.label ? `${layer.label}: ` : ""}${named(panel.x, layer.x[i])}${upright ? part : ""}`;
        words += `, ${named(panel.y, layer.y[i])}${upright ? "" : part}`;
      }
    });
    if (words && !(found.length && nearest > 100)) found.push(words);
    return found.join("; ") || this.hint;
  }

  coded(panel, code) {
    const low = along(panel.bar, panel.bar.low), high = along(panel.bar, panel.bar.high);
    const words = named(panel.bar, low + ((code - FIRST) / (255 - FIRST)) * (high - low));
    return words + (code === FIRST ? " or less" : code === 255 ? " or more" : "");
  }

  // Returns the error of a point: half of the band or bar below the curve.
  error(panel, k, i) {
    const band = panel.layers[k - 1], curve = panel.layers[k];
    if (!band?.along || band.along.length !== curve.x.length) return 0;
    const axis = band.upright ? panel.x : panel.y;
    return (value(axis, band.high[i]) - value(axis, band.low[i])) / 2 || 0;
  }

  select() {
    const { start, cursor, box } = this;
    this.start = null;
    if (!start || !cursor || !box) return;
    const sides = [[0, box.panel.x, box.fromX], [1, box.panel.y, box.fromY]];
    const wide = sides.filter(([k]) => Math.abs(cursor[k] - start[k]) > 8);
    if (!wide.length) return this.show();
    for (const [k, axis, from] of wide) {
      const ends = [from(start[k]), from(cursor[k])], range = this.range(axis);
      if (ends[0] < ends[1] !== range[0] < range[1]) ends.reverse();
      if (Math.abs(ends[1] - ends[0]) > 1e-6 * Math.abs(range[1] - range[0])) this.views.set(key(axis), ends);
    }
    this.zoom(this.views);
  }

  zoom(views) {
    if (!views) this.views.clear();
    this.all.hidden = !this.views.size;
    this.draw();
  }

  key(event) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const box = this.box || this.boxes[0];
    const [x, y] = this.cursor || [box.left + box.width / 2, box.top + box.height / 2];
    if (step) this.point(x + (step[0] * box.width) / 50, y + (step[1] * box.height) / 50);
    else if (event.key === "+" && this.cursor) {
      const half = [box.width / 4, box.height / 4];
      this.start = [x - half[0], y - half[1]];
      this.cursor = [x + half[0], y + half[1]];
      this.select();
      this.point(x, y);
    } else if (event.key === "Escape") this.zoom(null);
    else return;
    event.preventDefault();
  }
}

const within = ({ left, top, width, height }, x, y) =>
  x >= left - 1 && x <= left + width + 1 && y >= top - 1 && y <= top + height + 1;
const key = (axis) => `${axis.label} ${axis.low} ${axis.high}`;

// All at once, so that printing a page shows the figures that nobody has scrolled to.
for (const place of document.querySelectorAll("div.fig")) {
  const picture = new Picture(place);
  picture.begin().catch((error) => {
    picture.words.textContent = `The figure cannot be drawn: ${error.message}`;
  });
}
