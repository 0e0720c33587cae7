// The time axis that all panels share, and drawing on canvases.

const GUTTER = 62; // pixels left of the plots, for their axes
const RIGHT = 8;
const FONT = '11px Inter, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

class TimeAxis {
  // From the first block of sound, which was heard before the first picture, to the end of the last picture.
  constructor(episode) {
    this.start = episode.microphones.length ? -1 / fps : 0;
    this.end = episode.duration;
    this.width = 1;
  }
  x(time) {
    return GUTTER + ((time - this.start) / (this.end - this.start)) * (this.width - GUTTER - RIGHT);
  }
  time(x) {
    return this.start + ((x - GUTTER) / (this.width - GUTTER - RIGHT)) * (this.end - this.start);
  }
  ticks() {
    return niceTicks(0, this.end, Math.max(Math.floor((this.width - GUTTER) / 90), 2));
  }
}

function niceTicks(low, high, count) {
  const rough = (high - low || 1) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((candidate) => candidate >= rough * 0.999);
  const ticks = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) ticks.push(Number((i * step).toPrecision(12)));
  return ticks;
}

// A canvas's context in CSS pixels, cleared.
function contextOf(canvas, height) {
  const scale = window.devicePixelRatio || 1;
  canvas.style.height = `${height}px`;
  const width = canvas.clientWidth;
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(height * scale);
  const context = canvas.getContext("2d");
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.font = FONT;
  return { context, width, height };
}

// A plot's ground: surface, grid, vertical axis. `y` maps a value to pixels.
function drawGround(context, axis, top, bottom, ticks, y, unit, format = (value) => String(value)) {
  context.fillStyle = css("--plot");
  context.fillRect(GUTTER, top, axis.width - GUTTER - RIGHT, bottom - top);
  context.strokeStyle = css("--grid");
  context.lineWidth = 1;
  context.beginPath();
  for (const time of axis.ticks()) {
    const x = Math.round(axis.x(time)) + 0.5;
    context.moveTo(x, top);
    context.lineTo(x, bottom);
  }
  for (const value of ticks) {
    const height = Math.round(y(value)) + 0.5;
    context.moveTo(GUTTER, height);
    context.lineTo(axis.width - RIGHT, height);
  }
  context.stroke();
  drawScale(context, top, bottom, ticks, y, unit, format);
}

function drawScale(context, top, bottom, ticks, y, unit, format = (value) => String(value)) {
  context.fillStyle = css("--muted");
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (const value of ticks) {
    const height = Math.min(Math.max(y(value), top + 5), bottom - 5);
    context.fillText(format(value), GUTTER - 6, height);
  }
  context.save();
  context.translate(11, (top + bottom) / 2);
  context.rotate(-Math.PI / 2);
  context.textAlign = "center";
  context.fillText(unit, 0, 0);
  context.restore();
}

// Where the expert was in control: a light band behind the curves, unless that is everywhere.
function shadeInterventions(context, axis, episode, top, bottom) {
  const [first, last] = episode.interventions?.[0] ?? [];
  if (first !== 0 || last !== episode.frames - 1) fillInterventions(context, axis, episode, top, bottom, 0.14);
}

function fillInterventions(context, axis, episode, top, bottom, alpha) {
  context.save();
  context.globalAlpha = alpha;
  context.fillStyle = css("--expert");
  for (const [first, last] of episode.interventions ?? []) {
    context.fillRect(axis.x(first / fps), top, axis.x((last + 1) / fps) - axis.x(first / fps), bottom - top);
  }
  context.restore();
}

// Dark to bright with evenly growing lightness, told apart with any colour vision.
const INFERNO = [[0, 0, 4], [31, 12, 72], [85, 15, 109], [136, 34, 106], [186, 54, 85], [227, 89, 51], [249, 140, 10], [249, 201, 50], [252, 255, 164]];
const COLOURS = Uint8ClampedArray.from(
  Array.from({ length: 256 }, (_, level) => {
    const place = (level / 255) * (INFERNO.length - 1);
    const below = Math.min(Math.floor(place), INFERNO.length - 2);
    const share = place - below;
    return [0, 1, 2].map((c) => INFERNO[below][c] * (1 - share) + INFERNO[below + 1][c] * share);
  }).flat(),
);

function coloured(grey) {
  const canvas = make("canvas", { width: grey.width, height: grey.height });
  const context = canvas.getContext("2d");
  const image = context.createImageData(grey.width, grey.height);
  for (let i = 0; i < grey.data.length; i++) {
    image.data.set(COLOURS.subarray(3 * grey.data[i], 3 * grey.data[i] + 3), 4 * i);
    image.data[4 * i + 3] = 255;
  }
  context.putImageData(image, 0, 0);
  return canvas;
}
