"use strict";
// A player of sequences: what its elements hold is in replay.html, its data in nnode/pages/replay.py.
class Replay {
  constructor(figure) {
    const one = (name) => figure.querySelector(name);
    this.data = JSON.parse(one("script").textContent);
    this.canvas = one("canvas");
    this.pen = this.canvas.getContext("2d");
    [this.button, this.slider, this.output] = [one("button"), one("input"), one("output")];
    [this.speed, this.choice] = [one(".speed"), one(".choice")];
    this.still = matchMedia("(prefers-reduced-motion: reduce)");
    this.data.scenes.forEach((scene, i) => this.choice.add(new Option(scene.name, i)));
    this.button.onclick = () => this.play(!this.playing);
    this.slider.oninput = () => { this.play(false); this.show(Number(this.slider.value)); };
    this.choice.onchange = () => this.choose(this.choice.selectedIndex);
    figure.onkeydown = (event) => this.key(event);
    new ResizeObserver(() => this.show(this.time)).observe(this.canvas.parentElement);
    this.choose(this.data.first);
  }

  choose(number) {
    const raw = this.data.scenes[number];
    this.choice.selectedIndex = number;
    const tracks = (rows) => rows.map((row) => {
      let place = 0;
      return row.map((step) => (step === null ? NaN : (place += step) / 100));
    });
    const measured = tracks(raw.measured);
    const simulated = raw.simulated.map((s) => ({ title: s.title, note: s.note, x: tracks(s.x) }));
    this.scene = { ...raw, measured, simulated, number: measured.length / raw.dims };
    this.end = (measured[0].length - 1) * raw.dt;
    this.slider.max = this.end;
    this.play(false);
    this.scene.view = raw.dims === 1 ? this.lane() : this.plane();
    this.show(0);
  }

  // position of a track at the time shown, m; even motion between samples
  at(track, time = this.time) {
    const place = Math.min(Math.max(time / this.scene.dt, 0), track.length - 1), k = Math.floor(place);
    const [a, b] = [track[k], track[Math.min(k + 1, track.length - 1)]];
    return place === k ? a : a + (place - k) * (b - a);
  }
  // a simulation's distance from the measurement, m, root mean square over those who are there;
  // a leader that follows its measured path is left out
  away(x, time) {
    let sum = 0, count = 0;
    for (let i = 0; i < this.scene.number - (this.scene.led ?? 0); i++) {
      let square = 0;
      for (let d = 0; d < this.scene.dims; d++) {
        const j = i * this.scene.dims + d;
        square += (this.at(x[j], time) - this.at(this.scene.measured[j], time)) ** 2;
      }
      if (!Number.isNaN(square)) { sum += square; count += 1; }
    }
    return count ? Math.sqrt(sum / count) : NaN;
  }

  // a lane is seen from the middle of the measured cars, wide enough for all of them
  lane() {
    const { measured, simulated, dt } = this.scene;
    let half = 10;
    for (let k = 0; k < measured[0].length; k++) {
      const middle = this.middle(k * dt);
      for (const row of [measured, ...simulated.map((s) => s.x)].flat())
        if (Math.abs(row[k] - middle) < 5000) half = Math.max(half, Math.abs(row[k] - middle));
    }
    return { half: 1.05 * half + 5 };
  }
  middle(time) {
    const there = this.scene.measured.map((row) => this.at(row, time)).filter((x) => !Number.isNaN(x));
    if (there.length) this.seen = (Math.min(...there) + Math.max(...there)) / 2;
    return this.seen ?? 0;
  }
  // a plane shows where people walk, and the walls along it that are no farther than a room's width
  plane() {
    const box = [[Infinity, -Infinity], [Infinity, -Infinity]];
    this.scene.measured.forEach((row, j) => row.forEach((x) => {
      if (Number.isNaN(x)) return;
      box[j % 2] = [Math.min(box[j % 2][0], x), Math.max(box[j % 2][1], x)];
    }));
    box.forEach((side) => { side[0] -= 0.5; side[1] += 0.5; });
    for (const w of this.scene.walls ?? [])
      for (const d of [0, 1]) if (w[d] === w[d + 2] && w[d] > box[d][0] - 5 && w[d] < box[d][1] + 5)
        box[d] = [Math.min(box[d][0], w[d] - 0.2), Math.max(box[d][1], w[d] + 0.2)];
    return { box };
  }

  play(on) {
    this.playing = on;
    this.button.textContent = on ? "Pause" : "Play";
    this.last = null;
    cancelAnimationFrame(this.frame);
    this.canvas.dataset.playing = on;
    if (!on) return;
    if (this.time >= this.end) this.time = 0;
    this.frame = requestAnimationFrame((now) => this.tick(now));
  }
  tick(now) {
    const passed = this.last === null ? 0 : (now - this.last) / 1000;
    // who asked for less motion sees still moments, two in a second
    if (this.last === null || !this.still.matches || passed >= 0.5) {
      this.last = now;
      this.show(this.time + passed * Number(this.speed.value));
    }
    if (this.time >= this.end) this.play(false);
    else this.frame = requestAnimationFrame((next) => this.tick(next));
  }
  key(event) {
    const kind = event.target.tagName, name = event.key;
    if (kind === "SELECT" || event.ctrlKey || event.altKey || event.metaKey) return;
    if (kind === "BUTTON" && (name === " " || name === "Enter")) return;
    const step = this.still.matches ? Math.max(this.scene.dt, 0.5) : this.scene.dt;
    const moves = { ArrowLeft: -step, ArrowRight: step, Home: -this.end, End: this.end };
    const faster = { "+": 1, "=": 1, "-": -1 }[name], other = { PageUp: -1, PageDown: 1 }[name];
    if (name === " ") this.play(!this.playing);
    else if (name in moves) { this.play(false); this.show(this.time + moves[name]); }
    else if (faster) this.speed.selectedIndex = this.among(this.speed, faster);
    else if (other) this.choose(this.among(this.choice, other));
    else return;
    event.preventDefault();
  }
  among(list, step) { return Math.min(Math.max(list.selectedIndex + step, 0), list.length - 1); }

  show(time) {
    this.time = Math.min(Math.max(time, 0), this.end);
    this.slider.value = this.time;
    this.output.textContent = `${this.time.toFixed(1)} of ${this.end.toFixed(1)} s`;
    this.slider.setAttribute("aria-valuetext", this.output.textContent);
    const wide = this.canvas.parentElement.clientWidth;
    if (!wide) return;
    const panels = this.scene.dims === 1 ? this.lanes(wide) : this.planes(wide);
    const high = Math.round(panels.high + 56), dense = window.devicePixelRatio || 1;
    const { canvas, pen } = this;
    if (canvas.width !== Math.round(wide * dense) || canvas.height !== Math.round(high * dense)) {
      [canvas.width, canvas.height] = [Math.round(wide * dense), Math.round(high * dense)];
      canvas.style.height = `${high}px`;
    }
    pen.setTransform(dense, 0, 0, dense, 0, 0);
    pen.clearRect(0, 0, wide, high);
    pen.font = "12px system-ui, sans-serif";
    for (const panel of panels.list) this.panel(panel);
    this.curve(wide, panels.high);
    Object.assign(canvas.dataset, { time: this.time.toFixed(3), scene: this.scene.name });
  }

  // panels: where each lies on the canvas, and which part of the world it shows
  sources() {
    const { measured, simulated } = this.scene, { colours } = this.data;
    return [{ title: "measured", x: measured, colour: colours.measured },
      ...simulated.map((s, i) => ({ ...s, colour: colours.simulated[i % colours.simulated.length], ghost: measured }))];
  }
  lanes(wide) {
    const { half } = this.scene.view, middle = this.middle(this.time), scale = wide / (2 * half);
    const list = this.sources().map((source, i, all) => ({
      ...source, left: 0, top: 60 * i + 18, wide, high: 36, scale, at: [middle - half, 0],
      labels: i === all.length - 1,
    }));
    return { list, high: 60 * list.length + 14 };
  }
  planes(wide) {
    const [[x0, x1], [y0, y1]] = this.scene.view.box, all = this.sources();
    // above each other or beside each other, whichever shows more, all of it on one screen
    const fit = (columns, rows) => Math.min(
      (wide - 8 * (columns - 1)) / columns / (x1 - x0), (680 - 58 * rows) / rows / (y1 - y0));
    const beside = fit(all.length, 1) > fit(1, all.length);
    const scale = beside ? fit(all.length, 1) : fit(1, all.length), high = scale * (y1 - y0);
    const list = all.map((source, i) => ({
      ...source, left: beside ? i * (scale * (x1 - x0) + 8) : 0, top: beside ? 32 : 18 + i * (high + 44),
      wide: scale * (x1 - x0), high, scale, at: [x0, y1], labels: true,
    }));
    return { list, high: beside ? high + 58 : list.length * (high + 44) };
  }

  panel(p) {
    const { pen } = this, flat = this.scene.dims === 1;
    const u = (x) => p.left + (x - p.at[0]) * p.scale, v = (y) => p.top + (p.at[1] - y) * p.scale;
    pen.fillStyle = "#1a1a1a";
    pen.textAlign = "left";
    const away = p.ghost ? this.away(p.x, this.time) : NaN;
    const now = !p.ghost ? "" : Number.isNaN(away) ? "no agents" : `distance ${away.toFixed(2)} m`;
    const said = [p.note, now].filter(Boolean).join("; ");
    // narrow panels beside each other have room for two lines
    const lines = p.top === 32 ? [p.title, said] : ["", p.title + (said && `: ${said}`)];
    lines.forEach((line, i) => pen.fillText(line, p.left + 2, p.top - 19 + 14 * i, p.wide - 4));
    pen.save();
    pen.beginPath();
    pen.rect(p.left, p.top, p.wide, p.high);
    pen.clip();
    pen.fillStyle = flat ? "#e4e4e4" : "#f4f4f4";
    pen.fillRect(p.left, p.top, p.wide, p.high);
    for (const zone of this.data.zones) this.zone(zone, p, u, v);
    if (!flat) this.walls(u, v);
    for (let i = 0; i < this.scene.number; i++) flat ? this.car(i, p, u) : this.person(i, p, u, v);
    pen.restore();
    this.ticks(p, u);
  }
  zone(zone, p, u, v) {
    const now = this.scene.start + this.time, { pen } = this;
    if (zone.t && (now < zone.t[0] || now > zone.t[1])) return;
    pen.fillStyle = "#f3c66b";
    const [left, right] = zone.x ? zone.x.map(u) : [p.left, p.left + p.wide];
    const [low, high] = zone.y ? zone.y.map(v) : [p.top + p.high, p.top];
    if (zone.circle) {
      pen.beginPath();
      pen.arc(u(zone.circle[0]), v(zone.circle[1]), zone.circle[2] * p.scale, 0, 7);
      pen.fill();
    } else pen.fillRect(left, high, right - left, low - high);
    if (p.ghost) return;
    pen.fillStyle = "#5a4000";
    const x = zone.circle ? u(zone.circle[0]) : Math.max(left, p.left), top = zone.circle ? v(zone.circle[1]) : high;
    if (Math.min(right, p.left + p.wide) - x > 20 || zone.circle) pen.fillText(zone.label, x + 3, Math.max(top, p.top) + 12);
  }
  walls(u, v) {
    this.pen.strokeStyle = "#000";
    this.pen.lineWidth = 3;
    for (const [a, b, c, d] of this.scene.walls ?? []) this.line(u(a), v(b), u(c), v(d));
  }
  line(a, b, c, d) {
    this.pen.beginPath();
    this.pen.moveTo(a, b);
    this.pen.lineTo(c, d);
    this.pen.stroke();
  }
  car(i, p, u) {
    const front = u(this.at(p.x[i])), real = p.ghost ? u(this.at(p.ghost[i])) : NaN, { pen } = this;
    const long = Math.max((this.scene.length?.[i] ?? this.data.car) * p.scale, 4), top = p.top + 14;
    pen.lineWidth = 1.2;
    pen.strokeStyle = this.data.colours.measured;
    if (!Number.isNaN(real)) pen.strokeRect(real - long, top, long, 14);
    if (Number.isNaN(front)) return;
    pen.fillStyle = p.colour;
    pen.fillRect(front - long, top, long, 14);
    this.arrow(front, p.top + 8, real, p.top + 8);
  }
  person(i, p, u, v) {
    const [x, y] = [this.at(p.x[2 * i]), this.at(p.x[2 * i + 1])], { pen } = this;
    const real = p.ghost ? [this.at(p.ghost[2 * i]), this.at(p.ghost[2 * i + 1])] : [NaN, NaN];
    const size = Math.max(this.data.body * p.scale, 3), full = 2 * Math.PI;
    const disc = (a, b) => { pen.beginPath(); pen.arc(u(a), v(b), size, 0, full); };
    pen.lineWidth = 1.2;
    pen.strokeStyle = this.data.colours.measured;
    if (!Number.isNaN(real[0])) { disc(...real); pen.stroke(); }
    if (Number.isNaN(x)) return;
    pen.fillStyle = p.colour;
    disc(x, y);
    pen.fill();
    // where one is going: from the middle to the edge
    const later = Math.min(this.time + this.scene.dt, this.end), before = later - this.scene.dt;
    const way = [0, 1].map((d) => this.at(p.x[2 * i + d], later) - this.at(p.x[2 * i + d], before));
    const step = Math.hypot(...way);
    pen.strokeStyle = "#fff";
    pen.lineWidth = 1.5;
    if (step > 0) this.line(u(x), v(y), u(x) + size * way[0] / step, v(y) - size * way[1] / step);
    this.arrow(u(x), v(y), u(real[0]), v(real[1]));
  }
  // the residual: from where somebody is simulated to where he was measured
  arrow(a, b, c, d) {
    const long = Math.hypot(c - a, d - b), { pen } = this;
    if (!(long >= 1)) return;
    const [x, y, head] = [(c - a) / long, (d - b) / long, Math.min(5, long)];
    pen.strokeStyle = pen.fillStyle = "#000";
    pen.lineWidth = 1.4;
    this.line(a, b, c - head * x / 2, d - head * y / 2);
    pen.beginPath();
    pen.moveTo(c, d);
    pen.lineTo(c - head * x - head * y / 2, d - head * y + head * x / 2);
    pen.lineTo(c - head * x + head * y / 2, d - head * y - head * x / 2);
    pen.fill();
  }
  ticks(p, u) {
    const { pen } = this, from = p.at[0], to = from + p.wide / p.scale, most = Math.max(2, p.wide / 80);
    const ten = 10 ** Math.floor(Math.log10((to - from) / most));
    const step = [1, 2, 5, 10].map((n) => n * ten).find((n) => (to - from) / n <= most);
    pen.fillStyle = "#595959";
    pen.strokeStyle = "#888";
    pen.lineWidth = 1;
    pen.textAlign = "center";
    for (let x = Math.ceil(from / step) * step; x <= to; x += step) {
      this.line(u(x), p.top + p.high, u(x), p.top + p.high + (p.labels ? 4 : -5));
      const edge = u(x) - p.left < 14 || p.left + p.wide - u(x) < 22;
      if (p.labels && !edge) pen.fillText(`${Number(x.toFixed(6))} m`.replace("-", "−"), u(x), p.top + p.high + 15);
    }
  }

  // distance from the measurement over time, and where one is
  curve(wide, top) {
    const { pen, scene } = this, samples = scene.measured[0].length, high = 34;
    const rows = scene.simulated.map((s) => s.curve ??= Array.from({ length: samples }, (_, k) => this.away(s.x, k * scene.dt)));
    const most = Math.max(1e-9, ...rows.flat().filter((x) => !Number.isNaN(x)));
    pen.fillStyle = "#595959";
    pen.textAlign = "left";
    pen.fillText(`distance from the measurement (maximum ${most.toFixed(2)} m)`, 2, top + 16);
    pen.lineWidth = 1.6;
    rows.forEach((row, i) => {
      pen.strokeStyle = this.data.colours.simulated[i % this.data.colours.simulated.length];
      pen.beginPath();
      row.forEach((x, k) => pen.lineTo(wide * k / Math.max(samples - 1, 1), top + 20 + high * (1 - x / most)));
      pen.stroke();
    });
    pen.strokeStyle = "#000";
    pen.lineWidth = 1;
    const place = this.end ? wide * this.time / this.end : 0;
    this.line(place, top + 20, place, top + 20 + high);
  }
}
for (const figure of document.querySelectorAll("figure.replay")) figure.replay = new Replay(figure);
