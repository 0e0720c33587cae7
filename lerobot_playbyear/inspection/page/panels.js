// The panels of an episode, from top to bottom: moments, sound, curves, time.

const DASHES = [[], [5, 3], [1.5, 2.5], [8, 3, 2, 3]];
const N_COLOURS = 7;
const LONG_NAME = 8; // letters
const VERY_DIFFERENT = 8; // ranges: drawn on one scale the smallest curve would be flat

class Panel {
  constructor(episode, axis, height) {
    Object.assign(this, { episode, axis, height });
    this.canvas = make("canvas");
    this.legend = make("div", { className: "legend" });
    this.element = make("div", { className: "panel" }, this.canvas, this.legend);
  }
  draw() {
    const { context } = contextOf(this.canvas, this.height);
    this.paint(context, 3, this.height - 3);
  }
  // Shows the values of a moment in the legend.
  read() {}
}

class MomentsPanel extends Panel {
  constructor(episode, axis) {
    super(episode, axis, 30);
    const entries = [];
    if (episode.interventions) entries.push(make("span", { className: "expert" }, "expert"));
    if (episode.success !== null && episode.success >= 0) entries.push(make("span", {}, "✓ success"));
    if (episode.microphones.length) entries.push(make("span", {}, "▾ sudden sound"));
    this.legend.append(make("p", { className: "moments" }, ...entries));
  }
  paint(context, top, bottom) {
    const { axis, episode } = this;
    drawGround(context, axis, top, bottom, [], () => 0, "");
    fillInterventions(context, axis, episode, bottom - 7, bottom, 0.8);
    context.textBaseline = "middle";
    context.textAlign = "center";
    context.fillStyle = css("--sound");
    for (const microphone of episode.microphones) {
      for (const time of microphone.onsets) context.fillText("▾", axis.x(time), top + 7);
    }
    if (episode.success !== null && episode.success >= 0) {
      const x = axis.x(episode.success / fps);
      context.fillStyle = css("--ok");
      context.fillRect(x - 1, top, 2, bottom - top);
      context.font = `bold ${FONT}`;
      context.fillText("✓", x > axis.width - 30 ? x - 8 : x + 8, top + 7);
      context.font = FONT;
    }
  }
}

class WavePanel extends Panel {
  constructor(episode, axis, microphone) {
    super(episode, axis, episode.microphones.length > 1 ? 52 : 66);
    this.microphone = microphone;
    this.value = make("p");
    this.legend.append(
      make("h4", { title: microphone.key }, `Waveform · ${shortName(microphone.key)}`),
      make("p", {}, `${microphone.sample_rate.toLocaleString("en")} Hz`),
      this.value,
    );
  }
  paint(context, top, bottom) {
    const { axis, microphone, episode } = this;
    const limit = Math.max(microphone.peak, 1e-4);
    const y = (value) => (top + bottom) / 2 - (value / limit) * ((bottom - top) / 2 - 2);
    const tick = niceTicks(0, limit, 2).filter((value) => value <= limit).pop();
    drawGround(context, axis, top, bottom, [tick, 0, -tick], y, "full scale", (value) => value.toPrecision(2).replace(/\.?0+$/, "") || "0");
    shadeInterventions(context, axis, episode, top, bottom);
    const n = microphone.wave.length / 2;
    const [x0, x1] = [axis.x(-1 / fps), axis.x(episode.duration - 1 / fps)];
    context.fillStyle = css("--sound");
    for (let i = 0; i < n; i++) {
      const low = y((microphone.wave[2 * i] / 127) * limit);
      const high = y((microphone.wave[2 * i + 1] / 127) * limit);
      context.fillRect(x0 + (i / n) * (x1 - x0), high, Math.max((x1 - x0) / n, 0.75), Math.max(low - high, 0.75));
    }
  }
  read(time) {
    const { microphone, episode } = this;
    const i = Math.floor(((time + 1 / fps) / episode.duration) * (microphone.wave.length / 2));
    if (i < 0 || 2 * i >= microphone.wave.length) return void (this.value.textContent = "");
    const loudest = (Math.max(-microphone.wave[2 * i], microphone.wave[2 * i + 1]) / 127) * microphone.peak;
    this.value.textContent = loudest > 0 ? `peak ${(20 * Math.log10(loudest)).toFixed(0)} dBFS` : `below ${(20 * Math.log10(microphone.peak / 127)).toFixed(0)} dBFS`;
  }
}

class SpectrogramPanel extends Panel {
  constructor(episode, axis, microphone) {
    super(episode, axis, episode.microphones.length > 1 ? 100 : 136);
    this.microphone = microphone;
    this.picture = coloured(microphone.levels);
    const scale = make("canvas", { className: "scale", width: 256, height: 1 });
    scale.getContext("2d").drawImage(coloured({ width: 256, height: 1, data: Uint8Array.from({ length: 256 }, (_, i) => i) }), 0, 0);
    const ends = make("div", { className: "scale-ends" }, make("span", {}, `${microphone.bottom_db}`), make("span", {}, `${microphone.top_db} dBFS`));
    this.value = make("p");
    this.legend.append(make("h4", { title: microphone.key }, `Spectrogram · ${shortName(microphone.key)}`), scale, ends, this.value);
  }
  paint(context, top, bottom) {
    const { axis, microphone } = this;
    const y = (hertz) => bottom - (hertz / microphone.top_hz) * (bottom - top);
    drawGround(context, axis, top, bottom, [], y, "");
    const start = axis.x(-1 / fps);
    const end = axis.x(-1 / fps + this.picture.width * microphone.hop);
    context.imageSmoothingQuality = "high";
    context.drawImage(this.picture, start, top, end - start, bottom - top);
    drawScale(context, top, bottom, niceTicks(0, microphone.top_hz, 4), y, "kHz", (hertz) => String(hertz / 1000));
  }
  read(time, hertz) {
    const { levels, hop, top_hz: topHz, top_db: topDb, bottom_db: bottomDb } = this.microphone;
    const column = Math.floor((time + 1 / fps) / hop);
    this.value.textContent = "";
    if (column < 0 || column >= levels.width) return;
    const at = (row) => bottomDb + (levels.data[row * levels.width + column] / 255) * (topDb - bottomDb);
    let row = hertz === undefined ? 0 : Math.round((1 - hertz / topHz) * (levels.height - 1));
    // What hums below the lowest few bins is of no interest.
    if (hertz === undefined) for (let r = 1; r < levels.height - 3; r++) if (at(r) > at(row)) row = r;
    const kilohertz = ((1 - row / (levels.height - 1)) * topHz) / 1000;
    const level = at(row);
    this.value.textContent = `${hertz === undefined ? "loudest " : ""}${kilohertz.toFixed(2)} kHz: ${level <= bottomDb ? "under " : ""}${level.toFixed(0)} dBFS`;
  }
  hertz(y) {
    return Math.min(Math.max((this.height - 3 - y) / (this.height - 6), 0), 1) * this.microphone.top_hz;
  }
}

class CurvesPanel extends Panel {
  constructor(episode, axis, curve, settings) {
    const columns = curve.names.length > 4 && Math.max(...curve.names.map((name) => name.length)) < LONG_NAME ? 2 : 1;
    super(episode, axis, Math.max(112, 30 + 17 * Math.ceil(curve.names.length / columns)));
    Object.assign(this, { curve, settings });
    this.size = curve.names.length;
    const spans = curve.names.map((_, d) => curve.high[d] - curve.low[d]).filter((span) => span > 0);
    settings.own[curve.key] ??= Math.max(...spans) > VERY_DIFFERENT * Math.min(...spans);
    this.hidden = settings.hidden[curve.key] ||= new Set();
    this.values = curve.names.map(() => make("span", { className: "value" }));
    const button = make("button", { title: "One scale for all, or each dimension on its own (S)" });
    button.append((this.scaleName = make("span")));
    button.onclick = () => settings.toggleScale(curve.key);
    const title = make("h4", {}, curve.key);
    if (this.size > 1) title.append(button);
    const list = make("div", { className: columns > 1 ? "dimensions" : "dimensions wide" });
    curve.names.forEach((name, d) => {
      const entry = make("button", { title: `Show or hide ${name}` });
      entry.innerHTML = `<svg width="16" height="8"><line x1="0" x2="16" y1="4" y2="4" stroke="var(--c${d % N_COLOURS})" stroke-width="2.5" stroke-dasharray="${dash(d).join(" ")}"/></svg>`;
      entry.append(make("span", { className: "name" }, name), this.values[d]);
      entry.classList.toggle("off", this.hidden.has(d));
      entry.onclick = () => {
        entry.classList.toggle("off", !this.hidden.delete(d) && this.hidden.add(d).has(d));
        this.draw();
      };
      list.append(entry);
    });
    this.legend.append(title, list);
  }
  paint(context, top, bottom) {
    const { axis, episode, curve, size } = this;
    const shown = [...curve.names.keys()].filter((d) => !this.hidden.has(d));
    const own = this.settings.own[curve.key] && size > 1;
    this.scaleName.textContent = own ? "own scales" : "one scale";
    const low = own ? 0 : Math.min(...shown.map((d) => curve.low[d]), Infinity);
    const high = own ? 1 : Math.max(...shown.map((d) => curve.high[d]), -Infinity);
    const [floor, ceiling] = shown.length && high > low ? [low, high] : [(shown.length ? low : 0) - 1, (shown.length ? low : 0) + 1];
    const place = (value) => bottom - 5 - ((value - floor) / (ceiling - floor)) * (bottom - top - 10);
    const ticks = own ? [0, 1] : niceTicks(floor, ceiling, 3);
    const unit = own ? "each min–max" : curve.unit || "as recorded";
    drawGround(context, axis, top, bottom, ticks, place, unit, own ? (value) => (value ? "max" : "min") : undefined);
    shadeInterventions(context, axis, episode, top, bottom);
    context.save();
    context.beginPath();
    context.rect(GUTTER, top, axis.width - GUTTER - RIGHT, bottom - top);
    context.clip();
    context.lineWidth = 1.6;
    context.lineJoin = "round";
    for (const d of shown) {
      const span = curve.high[d] - curve.low[d] || 1;
      const y = (value) => place(own ? (value - curve.low[d]) / span : value);
      context.strokeStyle = css(`--c${d % N_COLOURS}`);
      context.setLineDash(dash(d));
      context.beginPath();
      let drawing = false;
      for (let t = 0; t < episode.frames; t++) {
        const value = curve.values[t * size + d];
        if (!Number.isFinite(value)) drawing = false;
        else {
          if (drawing) context.lineTo(axis.x(t / fps), y(value));
          else context.moveTo(axis.x(t / fps), y(value));
          if (curve.held) context.lineTo(axis.x((t + 1) / fps), y(value));
          drawing = true;
        }
      }
      context.stroke();
    }
    context.restore();
  }
  read(time) {
    const frame = Math.min(Math.max(Math.floor(time * fps + 1e-6), 0), this.episode.frames - 1);
    this.values.forEach((value, d) => (value.textContent = readable(this.curve.values[frame * this.size + d])));
  }
}

class TimePanel extends Panel {
  constructor(episode, axis) {
    super(episode, axis, 20);
    this.element.classList.add("time");
  }
  paint(context) {
    const { axis } = this;
    context.fillStyle = css("--muted");
    context.textBaseline = "middle";
    context.textAlign = "center";
    const ticks = axis.ticks();
    ticks.forEach((time) => context.fillText(`${time}${time === ticks.at(-1) ? " s" : ""}`, axis.x(time), 9));
  }
}

const dash = (d) => DASHES[Math.floor(d / N_COLOURS) % DASHES.length];
const readable = (value) => (Number.isFinite(value) ? (value === 0 || Math.abs(value) >= 0.0005 ? String(Number(value.toPrecision(3))) : value.toExponential(0)) : "NaN");

function panelsOf(episode, axis, settings) {
  const sound = episode.microphones.flatMap((m) => [new WavePanel(episode, axis, m), new SpectrogramPanel(episode, axis, m)]);
  const curves = episode.curves.map((curve) => new CurvesPanel(episode, axis, curve, settings));
  return [new MomentsPanel(episode, axis), ...sound, ...curves, new TimePanel(episode, axis)];
}
