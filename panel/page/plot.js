// Curves over time and in the plane: own canvas code, because the data arrive thinned.
import { words, number } from './words.js';

/** Widths of the axis gutter, constant so that a new label does not shift the picture. */
const LEFT = 66, RIGHT = 14, TOP = 6, BOTTOM = 22;

/** Ticks at 1, 2, 5 times a power of ten. @param {number} low @param {number} high @param {number} most */
export function ticks(low, high, most) {
  const raw = (high - low) / Math.max(most, 1), power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(f => f * power).find(s => s >= raw * 0.999999) ?? 10 * power;
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) found.push(i * step);
  return found;
}

/** A range with some space, never empty. @param {number} low @param {number} high */
function airy(low, high) {
  if (low > high) return [-1, 1];
  const space = high > low ? 0.06 * (high - low) : high === 0 ? 1 : 0.1 * Math.abs(high);
  return [low - space, high + space];
}

/** On what the theme depends, and what that was. */
const themes = ['(prefers-color-scheme: dark)', '(forced-colors: active)'].map(query => matchMedia(query));
let theme = '';
/** Colours of the theme, by name. @type {Map<string, string>} */
const known = new Map();

/** @param {CanvasRenderingContext2D} ctx @param {string} name */
function colour(ctx, name) {
  const now = themes.map(one => one.matches).join();
  if (now !== theme) known.clear();
  theme = now;
  let found = known.get(name);
  if (found === undefined) known.set(name, found = getComputedStyle(ctx.canvas).getPropertyValue(name).trim());
  return found;
}

/** Seconds before the right edge in which a moving picture is drawn anew each time: the last column grows. */
const ANEW = 0.3;
/** Shades of a path that fades. */
const FADES = 8;
/** On and off in the dashes of a moving line, pixels: they are counted from time 0 and so move with it. */
const MOVING_DASH = [5, 4];

/** @param {HTMLCanvasElement} canvas */
const context2d = canvas => /** @type {CanvasRenderingContext2D} */ (canvas.getContext('2d'));

export const COLOURS = ['--c0', '--c1', '--c2', '--c3'];
export const DASHES = [[], [8, 4], [2, 3], [10, 3, 2, 3]];

/**
 * Draws the sample of a line beside a name.
 * @param {HTMLCanvasElement} canvas @param {string} name @param {number[]} dash
 */
export function sample(canvas, name, dash) {
  const ratio = devicePixelRatio;
  canvas.width = 24 * ratio;
  canvas.height = 8 * ratio;
  const ctx = context2d(canvas);
  ctx.scale(ratio, ratio);
  ctx.strokeStyle = colour(ctx, name);
  ctx.lineWidth = 2;
  ctx.setLineDash(dash);
  ctx.beginPath();
  ctx.moveTo(0, 4);
  ctx.lineTo(24, 4);
  ctx.stroke();
}

/**
 * @typedef {{ x: Float64Array, y: Float64Array, colour: string, dash: number[], ghost: boolean, step: boolean, curve: number, still?: boolean, by?: number, fades?: boolean }} Line
 */

/** One canvas with its axes, over time (`plane` false) or in the plane. */
export class Plot {
  /** @param {HTMLElement} parent @param {boolean} plane */
  constructor(parent, plane) {
    this.plane = plane;
    this.root = document.createElement('div');
    this.root.className = 'plot';
    this.names = document.createElement('ul');
    this.names.className = 'names';
    this.stack = document.createElement('div');
    this.stack.className = `stack ${plane ? 'planes' : 'times'}`;
    [this.grid, this.curves, this.marks] = [0, 1, 2].map(() => {
      const canvas = document.createElement('canvas');
      this.stack.append(canvas);
      return canvas;
    });
    this.grid.setAttribute('aria-hidden', 'true');
    this.marks.setAttribute('aria-hidden', 'true');
    this.curves.setAttribute('role', 'img');
    this.root.append(this.names, this.stack);
    parent.append(this.root);
    this.width = this.height = 0;
    /** @type {[number, number]} */
    this.span = [0, 1];
    /** @type {[number, number]} */
    this.range = [0, 1];
    this.shrunk = 0;
    this.empty = true;
    this.blank = true;
    /** What the moving picture shows: its last pixel, counted from time 0, and all on which the others depend. @type {{ n: number, key: string } | null} */
    this.moved = null;
    this.title = '';
    /** When its values were written last, ms. */
    this.named = 0;
  }

  /** Fits the canvases to their place in device pixels. @returns {boolean} whether that changed something */
  fit() {
    const box = this.stack.getBoundingClientRect(), ratio = devicePixelRatio;
    const width = Math.round(box.width * ratio), height = Math.round(box.height * ratio);
    if (width === this.grid.width && height === this.grid.height) return false;
    for (const canvas of [this.grid, this.curves, this.marks]) {
      canvas.width = width;
      canvas.height = height;
    }
    [this.width, this.height] = [box.width, box.height];
    this.moved = null;
    return true;
  }

  /** Columns of the picture, in device pixels. */
  columns() {
    return Math.max(1, Math.min(4096, Math.round((this.width - LEFT - RIGHT) * devicePixelRatio)));
  }

  /** @param {number} value */
  atX(value) { return LEFT + (value - this.span[0]) / (this.span[1] - this.span[0]) * (this.width - LEFT - RIGHT); }
  /** @param {number} value */
  atY(value) { return this.height - BOTTOM - (value - this.range[0]) / (this.range[1] - this.range[0]) * (this.height - TOP - BOTTOM); }
  /** The value at a position. @param {number} x */
  fromX(x) { return this.span[0] + (x - LEFT) / (this.width - LEFT - RIGHT) * (this.span[1] - this.span[0]); }

  /**
   * Draws lines. Ranges grow at once and shrink only where nothing has grown for a second. A picture that moves is shifted
   * by whole pixels, and only its right edge is drawn.
   * @param {Line[]} lines @param {[number, number] | null} span @param {boolean} [moves]
   */
  draw(lines, span, moves = false) {
    const pixels = Math.round((this.width - LEFT - RIGHT) * devicePixelRatio);
    let n = 0, each = 0;
    if (span && moves) {
      // The same each time, in spite of rounding.
      each = Number(((span[1] - span[0]) / pixels).toPrecision(9));
      n = Math.floor(span[1] / each);
      span = [(n - pixels) * each, n * each];
    }
    let low = Infinity, high = -Infinity, left = Infinity, right = -Infinity;
    for (const line of lines) {
      for (let i = 0; i < line.x.length; i++) {
        const x = line.x[i] + (line.by ?? 0), y = line.y[i];
        if (span && (x < span[0] || x > span[1]) || !Number.isFinite(y)) continue;
        if (y < low) low = y;
        if (y > high) high = y;
        if (x < left) left = x;
        if (x > right) right = x;
      }
    }
    const [below, above] = airy(low, high), now = performance.now();
    const grows = below < this.range[0] || above > this.range[1];
    if (low <= high && this.empty) {
      this.empty = false;
      this.range = [below, above];
      this.shrunk = now;
    } else if (grows && low <= high || low <= high && now - this.shrunk > 1000) {
      const old = now - this.shrunk > 1000;
      this.range = old ? [below, above] : [Math.min(below, this.range[0]), Math.max(above, this.range[1])];
      this.shrunk = now;
    }
    if (span) this.span = span; else this.span = /** @type {[number, number]} */ (airy(left, right));
    this.drawGrid();
    this.drawStill(lines.filter(line => line.still));
    lines = lines.filter(line => !line.still);
    const bottom = this.height - BOTTOM, edge = this.width - RIGHT;
    const key = moves ? [each, this.range, themes.map(one => one.matches), lines.map(line => [line.colour, line.dash, line.curve])].join() : '';
    const by = moves && this.moved?.key === key ? n - this.moved.n : -1;
    this.moved = moves ? { n, key } : null;
    let from = LEFT;
    const ctx = context2d(this.curves);
    ctx.save();
    if (by >= 0 && by < pixels) {
      const ratio = devicePixelRatio;
      from = Math.max(LEFT, edge - (by + Math.ceil(ANEW / each) + 2) / ratio);
      // On whole device pixels, so that the seam is none.
      from = Math.ceil(from * ratio) / ratio;
      ctx.setTransform(1, 0, 0, 1, 0, 0);
      if (by > 0) {
        ctx.globalCompositeOperation = 'copy';
        ctx.drawImage(this.curves, -by, 0);
        ctx.globalCompositeOperation = 'source-over';
      }
      ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
      // What was shifted out to the left, too.
      ctx.clearRect(0, 0, LEFT, this.height);
      ctx.clearRect(from, 0, this.width - from, this.height);
    } else {
      this.context(this.curves);
    }
    ctx.beginPath();
    ctx.rect(from, TOP, edge - from, bottom - TOP);
    ctx.clip();
    ctx.lineJoin = 'round';
    for (const line of lines) {
      const n = line.x.length;
      // The older parts of a path are fainter.
      for (let part = 0; line.fades && part < FADES; part++) {
        ctx.globalAlpha = 0.2 + 0.8 * (part + 1) / FADES;
        this.trace(ctx, line, Math.floor(n * part / FADES), Math.min(n, Math.floor(n * (part + 1) / FADES) + 1));
      }
      if (!line.fades) this.trace(ctx, line, from > LEFT ? Math.max(0, after(line.x, this.fromX(from)) - 2) : 0, n, moves && line.dash.length ? each : 0);
    }
    ctx.restore();
    return { low, high };
  }

  /** @param {HTMLCanvasElement} canvas */
  context(canvas) {
    const ctx = context2d(canvas);
    ctx.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    ctx.clearRect(0, 0, this.width, this.height);
    return ctx;
  }

  /** Lines that stand still while others move: below these, with the grid. @param {Line[]} lines */
  drawStill(lines) {
    const ctx = context2d(this.grid);
    ctx.save();
    ctx.beginPath();
    ctx.rect(LEFT, TOP, this.width - LEFT - RIGHT, this.height - TOP - BOTTOM);
    ctx.clip();
    for (const line of lines) this.trace(ctx, line, 0, line.x.length);
    ctx.restore();
  }

  /** Draws a part of a line. `each`: seconds a pixel of one that moves, whose dashes are counted by them. @param {CanvasRenderingContext2D} ctx @param {Line} line @param {number} first @param {number} last */
  trace(ctx, line, first, last, each = 0) {
    ctx.strokeStyle = colour(ctx, line.colour);
    ctx.lineWidth = line.ghost ? 1.3 : 1.6;
    ctx.setLineDash(each ? [] : line.dash);
    ctx.beginPath();
    let pen = false, before = 0;
    for (let i = first; i < last; i++) {
      const x = line.x[i], y = line.y[i];
      if (!Number.isFinite(y) || each && Math.floor(x / each) % (MOVING_DASH[0] + MOVING_DASH[1]) >= MOVING_DASH[0]) { pen = false; continue; }
      const px = this.atX(x + (line.by ?? 0)), py = this.atY(y);
      if (pen && line.step) ctx.lineTo(px, before);
      if (pen) ctx.lineTo(px, py); else ctx.moveTo(px, py);
      pen = true;
      before = py;
    }
    ctx.stroke();
  }

  drawGrid() {
    const ctx = this.context(this.grid), bottom = this.height - BOTTOM, right = this.width - RIGHT;
    ctx.font = '13px system-ui, sans-serif';
    ctx.lineWidth = 1;
    ctx.strokeStyle = colour(ctx, '--grid');
    ctx.fillStyle = colour(ctx, '--faint');
    ctx.textAlign = 'right';
    ctx.textBaseline = 'middle';
    for (const tick of ticks(this.range[0], this.range[1], Math.max(2, (this.height - BOTTOM) / 40))) {
      const y = Math.round(this.atY(tick)) + 0.5;
      ctx.beginPath();
      ctx.moveTo(LEFT, y);
      ctx.lineTo(right, y);
      ctx.stroke();
      ctx.fillText(number(Math.abs(tick) < 1e-12 * (this.range[1] - this.range[0]) ? 0 : tick, 4), LEFT - 8, y);
    }
    ctx.textBaseline = 'alphabetic';
    ctx.textAlign = 'center';
    for (const tick of ticks(this.span[0], this.span[1], Math.max(2, this.width / 110))) {
      const x = Math.round(this.atX(tick)) + 0.5;
      ctx.beginPath();
      ctx.moveTo(x, TOP);
      ctx.lineTo(x, bottom);
      ctx.stroke();
      const text = number(Math.abs(tick) < 1e-12 * (this.span[1] - this.span[0]) ? 0 : tick, 6);
      const half = ctx.measureText(text).width / 2;
      if (x + half < right + RIGHT) ctx.fillText(text, x, this.height - 6);
    }
    ctx.textAlign = 'left';
    ctx.fillText(this.title, 8, this.height - 6);
  }

  /** The pointer, events, cursors. @param {number | null} pointer @param {{ t: number, kind: string }[]} events @param {number[]} cursors */
  drawMarks(pointer, events, cursors) {
    const [left, right] = this.span, inside = events.filter(event => event.t >= left && event.t <= right);
    const blank = inside.length === 0 && cursors.length === 0 && pointer === null;
    if (blank && this.blank) return;
    this.blank = blank;
    const ctx = this.context(this.marks);
    ctx.lineWidth = 1;
    const line = (/** @type {number} */ t, /** @type {string} */ name, /** @type {number[]} */ dash) => {
      const x = Math.round(this.atX(t)) + 0.5;
      if (x < LEFT || x > this.width - RIGHT) return;
      ctx.strokeStyle = colour(ctx, name);
      ctx.setLineDash(dash);
      ctx.beginPath();
      ctx.moveTo(x, TOP);
      ctx.lineTo(x, this.height - BOTTOM);
      ctx.stroke();
    };
    for (const event of inside) line(event.t, { bad: '--bad', warning: '--warning', good: '--good' }[event.kind] ?? '--faint', [2, 3]);
    for (const cursor of cursors) line(cursor, '--text', [6, 3]);
    if (pointer !== null) line(pointer, '--faint', []);
  }

  /** What it shows in a sentence, for those who cannot see it. @param {string} text */
  tell(text) {
    this.curves.setAttribute('aria-label', text);
  }
}

/** How many numbers of a rising list are not above a value. @param {Float64Array} x @param {number} value */
function after(x, value) {
  let low = 0, high = x.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (x[middle] <= value) low = middle + 1; else high = middle;
  }
  return low;
}

/** The value of a curve at a time. @param {{ x: Float64Array, y: Float64Array }} curve @param {number} t */
export function valueAt(curve, t) {
  const low = after(curve.x, t);
  if (low === 0 || low > curve.x.length) return NaN;
  if (low === curve.x.length) return curve.y[low - 1];
  const [x0, x1, y0, y1] = [curve.x[low - 1], curve.x[low], curve.y[low - 1], curve.y[low]];
  return x1 > x0 ? y0 + (y1 - y0) * (t - x0) / (x1 - x0) : y0;
}

/** How late cycles began. @param {HTMLElement} parent @param {any} late @param {number} period */
export function bars(parent, late, period) {
  const canvas = document.createElement('canvas');
  canvas.setAttribute('role', 'img');
  canvas.setAttribute('aria-label', words.lateWords(late));
  parent.replaceChildren(canvas);
  const box = parent.getBoundingClientRect(), ratio = devicePixelRatio;
  canvas.width = box.width * ratio;
  canvas.height = box.height * ratio;
  const ctx = context2d(canvas);
  ctx.scale(ratio, ratio);
  const most = Math.max(1, ...late.counts), last = Math.log10(late.edges[late.edges.length - 1]);
  const atX = (/** @type {number} */ us) => 6 + Math.log10(us) / last * (box.width - 12);
  ctx.fillStyle = colour(ctx, '--c0');
  late.counts.forEach((/** @type {number} */ count, /** @type {number} */ i) => {
    if (!count) return;
    const height = Math.max(2, (box.height - 40) * Math.log1p(count) / Math.log1p(most));
    ctx.fillRect(atX(late.edges[i]) + 0.5, box.height - 22 - height, atX(late.edges[i + 1]) - atX(late.edges[i]) - 1, height);
  });
  ctx.font = '13px system-ui, sans-serif';
  ctx.textAlign = 'center';
  for (const [us, name] of /** @type {[number, string][]} */ ([[1, '1'], [10, '10'], [100, '100'], [1000, '1000'], [10000, '10 000']])) {
    ctx.fillStyle = colour(ctx, '--faint');
    ctx.fillText(name, Math.max(8, Math.min(atX(us), box.width - 24)), box.height - 5);
  }
  for (const [part, name] of /** @type {[number, string][]} */ ([[20, 'T/20'], [5, 'T/5']])) {
    const x = atX(period * 1e6 / part);
    ctx.fillStyle = colour(ctx, part === 5 ? '--bad' : '--warning');
    ctx.fillRect(x, 16, 1.5, box.height - 38);
    ctx.fillText(name, x, 12);
  }
}
