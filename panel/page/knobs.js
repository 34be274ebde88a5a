// Parameters: a slider and a field each.
import { words, number } from './words.js';

/** Positions of a slider: a step of the arrow keys is 10 of them, with Shift 1. */
const STEPS = 2000;

/** @typedef {{ path: string, unit: string, doc: string | null, boolean: boolean, from: number, to: number, logarithmic: boolean, own: number }} Knob */

/** @param {Knob} knob @param {number} value */
export function position(knob, value) {
  const { from, to, logarithmic } = knob;
  const part = logarithmic ? Math.log(value / from) / Math.log(to / from) : (value - from) / (to - from);
  return Math.round(STEPS * Math.min(1, Math.max(0, Number.isFinite(part) ? part : 0)));
}

/** The value of a position, with no more digits than the slider resolves. @param {Knob} knob @param {number} at */
export function valueOf(knob, at) {
  const { from, to, logarithmic } = knob, part = at / STEPS;
  if (at === 0) return from;
  if (at === STEPS) return to;
  const value = logarithmic ? from * (to / from) ** part : from + (to - from) * part;
  if (logarithmic) return Number(value.toPrecision(4));
  const step = (to - from) / STEPS, digits = Math.max(0, Math.min(20, Math.ceil(-Math.log10(step)) + 1));
  return step >= 1 ? Math.round(value) : Number(value.toFixed(digits));
}

/** A value as a line of the panel wants it. @param {Knob} knob @param {number} value */
function typed(knob, value) {
  if (!Number.isFinite(value)) return value < 0 ? '-inf' : 'inf';
  return knob.boolean ? String(value !== 0) : `${value} ${knob.unit}`.trim();
}

export class Knobs {
  /**
   * @param {HTMLElement} parent @param {Knob[]} knobs @param {(line: string, refused: (why: string) => void) => void} say
   * @param {boolean} stages whether a touch only prepares a change, and all are sent together
   */
  constructor(parent, knobs, say, stages = false) {
    this.knobs = knobs;
    this.stages = stages;
    /** Changes that were prepared, as text. @type {Map<number, string>} */
    this.staged = new Map();
    this.onstaged = () => {};
    // JSON has no infinity: a value without end is null.
    for (const knob of knobs) knob.own = knob.own ?? Infinity;
    this.values = knobs.map(knob => knob.own);
    /** What the panel has. */
    this.actual = [...this.values];
    /** The values before each touch. @type {number[][]} */
    this.before = [];
    this.touched = -1;
    /** The field that is being typed in. */
    this.editing = -1;
    this.live = true;
    this.onundo = () => {};
    this.say = say;
    this.rows = knobs.map((knob, i) => this.row(knob, i));
    parent.replaceChildren(...this.rows.map(row => row.root));
  }

  /** @param {Knob} knob @param {number} i */
  row(knob, i) {
    const root = document.createElement('div'), top = document.createElement('div'), label = document.createElement('label');
    root.className = 'knob';
    top.className = 'top';
    const name = document.createElement('b');
    name.textContent = knob.path;
    label.append(name);
    if (knob.doc) {
      const doc = document.createElement('span');
      doc.textContent = ` ${knob.doc}`;
      label.append(doc);
    }
    const refused = document.createElement('p');
    refused.className = 'refused';
    refused.id = `refused-${i}`;
    refused.setAttribute('role', 'alert');
    refused.hidden = true;
    const field = document.createElement('input');
    field.id = `field-${i}`;
    label.htmlFor = field.id;
    const now = document.createElement('p');
    now.className = 'now';
    now.hidden = true;
    const send = (/** @type {string} */ text) => {
      refused.hidden = true;
      if (this.stages) {
        this.staged.set(i, text);
        this.show(i);
        return this.onstaged();
      }
      this.say(`set ${knob.path} = ${text}`, why => {
        refused.textContent = why;
        refused.hidden = false;
      });
    };
    if (knob.boolean) {
      field.type = 'checkbox';
      field.onchange = () => {
        this.touch(i);
        this.release();
        send(String(field.checked));
      };
      top.append(label, field);
      root.append(top, now, refused);
      return { root, field, slider: null, refused, now, send };
    }
    field.type = 'text';
    field.autocomplete = 'off';
    field.spellcheck = false;
    field.setAttribute('aria-describedby', refused.id);
    // A bare number is in the unit that stands beside it.
    const text = () => {
      const bare = field.value.trim() !== '' && Number.isFinite(Number(field.value.replace('−', '-')));
      return bare ? typed(knob, Number(field.value.replace('−', '-'))) : field.value.trim();
    };
    field.oninput = () => { this.editing = i; };
    field.onkeydown = event => {
      if (event.key === 'Enter') {
        const edited = this.editing === i;
        this.editing = -1;
        if (this.stages) {
          if (edited) send(text());
          this.apply();
        } else {
          this.touch(i);
          this.release();
          send(text());
        }
      }
      if (event.key === 'Escape') {
        this.editing = -1;
        this.show(i);
      }
    };
    field.onchange = () => {
      if (this.stages && this.editing === i) send(text());
      this.editing = -1;
    };
    field.onblur = () => {
      this.editing = -1;
      this.show(i);
    };
    if (!Number.isFinite(knob.own)) {
      top.append(label, field);
      root.append(top, now, refused);
      return { root, field, slider: null, refused, now, send };
    }
    const slider = document.createElement('input');
    slider.type = 'range';
    slider.min = '0';
    slider.max = String(STEPS);
    slider.step = '1';
    slider.setAttribute('aria-label', words.slider(knob.path));
    const moved = (/** @type {boolean} */ last) => {
      this.touch(i);
      this.values[i] = valueOf(knob, Number(slider.value));
      this.show(i);
      if (last || this.live) send(typed(knob, this.values[i]));
    };
    slider.onpointerdown = () => this.touch(i);
    // A click that moves nothing is followed by no `change`.
    slider.onpointerup = () => setTimeout(() => this.release());
    slider.oninput = () => moved(false);
    slider.onchange = () => { if (!this.live) moved(true); this.release(); };
    slider.onkeydown = event => {
      const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
      if (!way) return;
      event.preventDefault();
      event.stopPropagation();
      slider.value = String(Number(slider.value) + way * (event.shiftKey ? 1 : 10));
      moved(false);
    };
    slider.onkeyup = event => { if (event.key.startsWith('Arrow')) { if (!this.live) moved(true); this.release(); } };
    top.append(label, field);
    root.append(top, slider, now, refused);
    return { root, field, slider, refused, now, send };
  }

  /** Before a change: remembers the values for undo, once a touch. @param {number} i */
  touch(i) {
    if (this.touched === i) return;
    this.touched = i;
    this.before.push([...this.values]);
    if (this.before.length > 100) this.before.shift();
    this.onundo();
  }

  release() {
    this.touched = -1;
  }

  /** Sends what was prepared, as one set. Then each control shows what the rig has. */
  apply() {
    if (this.staged.size === 0) return;
    const text = [...this.staged].map(([i, value]) => `${this.knobs[i].path} = ${value}`).join(', '), rows = [...this.staged.keys()];
    this.say(`set ${text}`, why => {
      const { refused } = this.rows[rows[0]];
      refused.textContent = why;
      refused.hidden = false;
    });
    this.discard();
  }

  /** Prepares the values that differ from these. @param {string[]} texts @param {string[]} now */
  prepare(texts, now) {
    texts.forEach((text, i) => { if (text !== now[i]) this.rows[i]?.send(text); });
  }

  /** Forgets what was prepared. */
  discard() {
    this.staged.clear();
    this.touched = -1;
    this.follow([...this.actual]);
    this.onstaged();
  }

  undo() {
    if (this.stages) return this.discard();
    const values = this.before.pop();
    this.onundo();
    if (!values) return;
    const changed = this.knobs.map((knob, i) => [knob, i]).filter(([, i]) => values[/** @type {number} */ (i)] !== this.values[/** @type {number} */ (i)]);
    if (changed.length === 0) return this.undo();
    const text = changed.map(([knob, i]) => `${/** @type {Knob} */ (knob).path} = ${typed(/** @type {Knob} */ (knob), values[/** @type {number} */ (i)])}`).join(', ');
    this.say(`set ${text}`, () => {});
  }

  /** The values that the panel has; a control under the hand does not follow. @param {number[]} values */
  follow(values) {
    values.forEach((value, i) => {
      this.actual[i] = value ?? Infinity;
      if (this.staged.has(i)) return this.show(i);
      if (i === this.touched && this.rows[i].slider) return;
      this.values[i] = value ?? Infinity;
      this.show(i);
    });
  }

  /** What stands in a field. @param {number} i */
  text(i) {
    return this.staged.get(i) ?? `${number(this.values[i], 5)} ${this.knobs[i].unit}`.trim();
  }

  /** @param {number} i */
  show(i) {
    const { root, field, slider, now } = this.rows[i], knob = this.knobs[i], value = this.values[i];
    root.classList.toggle('changed', this.staged.has(i) || value !== knob.own && !(Math.abs(value - knob.own) <= 1e-12 * Math.abs(knob.own)));
    now.hidden = !this.staged.has(i);
    if (!now.hidden) {
      const text = words.now(knob.boolean ? String(this.actual[i] !== 0) : `${number(this.actual[i], 5)} ${knob.unit}`.trim());
      if (now.textContent !== text) now.textContent = text;
    }
    if (knob.boolean) {
      if (!this.staged.has(i)) field.checked = value !== 0;
      return;
    }
    const text = this.text(i);
    if (this.editing !== i && field.value !== text) field.value = text;
    if (slider) {
      if (this.touched !== i) slider.value = String(position(knob, value));
      slider.setAttribute('aria-valuetext', text);
    }
  }
}
