// Puts the page together.
import { words, number } from './words.js';
import { decode, connect, embedded, joined } from './link.js';
import { Plot, COLOURS, DASHES, sample, valueAt, bars } from './plot.js';
import { Knobs } from './knobs.js';

/** Seconds that are shown of what still grows. */
const LAST = 20;

const element = (/** @type {string} */ id) => /** @type {HTMLElement} */ (document.getElementById(id));
const input = (/** @type {string} */ id) => /** @type {HTMLInputElement} */ (document.getElementById(id));

let /** @type {any} */ hello = null, /** @type {any} */ state = null;
/** The window of time; null: all. @type {[number, number] | null} */
let window_ = null;
/** Seconds up to the newest, while more comes; null: the window stands. @type {number | null} */
let newest = null;
/** What the window was before it was held. */
let before = LAST;
/** The end of the data in the latest frame, s. */
let end = 0;
/** @type {{ plot: Plot, canvas: any, curves: Map<number, any> }[]} */
let plots = [];
let /** @type {Knobs | null} */ knobs = null;
let /** @type {number | null} */ pointer = null;
/** Two cursors as parts of the window; null: off. @type {[number, number] | null} */
let cursors = null;
/** Frames that wait to be drawn. @type {ArrayBuffer[]} */
let frames = [];
let dirty = false, asked = false, told = 0;
/** What to do with refusals, by the number of the line. @type {Map<number, (why: string) => void>} */
const refusals = new Map();

const saved = document.getElementById('data');
const link = saved ? embedded(JSON.parse(saved.textContent ?? '{}'), message) : connect(buffer => { frames.push(buffer); wake(); }, message, lost);

/** @param {any} what */
function message(what) {
  if (what.kind === 'hello') begin(what.is);
  if (what.kind === 'state') { state = what.is; show(); }
  if (what.kind === 'answer') {
    const refuse = refusals.get(what.number);
    refusals.delete(what.number);
    if (what.refused) (refuse ?? (why => problem(why)))(what.refused);
    else if (hello?.kind === 'rig') problem(null);
  }
}

/** @param {string} why */
function lost(why) {
  sentence('old', why);
  document.body.classList.add('lost');
}

/** @param {string} kind @param {string} text */
function sentence(kind, text) {
  const place = element('sentence');
  place.className = kind;
  if (place.textContent !== text) place.textContent = text;
  document.title = `${kind === 'good' ? '●' : kind === 'bad' ? '▲' : '■'} ${hello?.title ?? 'fric'}`;
}

/** @param {string | null} text */
function problem(text) {
  const place = element('problem');
  place.hidden = !text;
  if (text && place.textContent !== text) place.textContent = text;
}

/** A command to a rig, with the picture that was seen. @param {string} line @param {(why: string) => void} refused */
function command(line, refused) {
  say(`@${end} ${line}`, refused);
}

let /** @type {any} */ unconfirmed = 0;

/** Stops the rig: always, whatever is shown or under way. */
function stop() {
  say('stop', problem);
  clearTimeout(unconfirmed);
  unconfirmed = setTimeout(() => { if (!state?.over && /^(armed|wait|enab|test)/.test(state?.stage ?? 'armed')) problem(words.notConfirmed); }, 500);
}

let sureUntil = 0;

/** The next step of a rig. Arm wants a second press. */
function next() {
  const step = state?.next;
  if (step === 'arm' && performance.now() > sureUntil) {
    sureUntil = performance.now() + 3000;
    setTimeout(steps, 3010);
    return steps();
  }
  sureUntil = 0;
  if (step === 'enable' || step === 'arm') command(step, problem);
  steps();
}

function steps() {
  const step = /** @type {'enable' | 'arm' | '-'} */ (state?.next ?? '-'), place = element('next'), sure = performance.now() < sureUntil;
  place.hidden = hello?.kind !== 'rig' || step === '-' || !!saved;
  if (step === '-') return;
  place.textContent = (sure ? words.sure : words.next)[step];
  place.classList.toggle('sure', sure);
}

/** A line that may be refused. @param {string} line @param {(why: string) => void} refused */
function say(line, refused) {
  refusals.set(link.say(line), refused);
  if (refusals.size > 300) refusals.delete(refusals.keys().next().value ?? 0);
}

function begin(/** @type {any} */ is) {
  // Frames that wait are of signals that may be others now.
  if (frames.length) link.send(`ack ${new DataView(frames[frames.length - 1]).getUint32(0, true)}`);
  frames = [];
  hello = is;
  window_ = null;
  newest = hello.grows ? LAST : null;
  end = hello.to;
  element('title').textContent = hello.title;
  const choices = element('choices');
  choices.setAttribute('aria-label', words.experiments);
  choices.replaceChildren(...(hello.experiments.length > 1 && !saved ? hello.experiments : []).map((/** @type {string} */ name) =>
    button(name, () => say(`experiment ${name}`, problem), name === hello.title)));
  element('times').replaceChildren();
  element('planes').replaceChildren();
  plots = hello.canvases.map((/** @type {any} */ canvas) => {
    const plane = canvas.against !== null;
    return { plot: new Plot(element(plane ? 'planes' : 'times'), plane), canvas, curves: new Map() };
  });
  const times = plots.filter(one => !one.plot.plane);
  times.forEach(one => {
    one.plot.title = words.time;
    follow(one.plot);
  });
  plots.filter(one => one.plot.plane).forEach(one => { one.plot.title = hello.signals[one.canvas.against].unit; });
  plots.forEach(names);
  const unit = element('knobs');
  unit.hidden = hello.knobs.length === 0 || !!saved;
  const rig = hello.kind === 'rig';
  knobs = unit.hidden ? null : new Knobs(element('rows'), hello.knobs, rig ? command : say, rig);
  for (const id of ['undo', 'text', 'kept', 'copy']) element(id).hidden = rig;
  element('stages').hidden = !rig;
  element('stop').hidden = !rig || !!saved;
  if (knobs) knobs.onstaged = () => {
    const n = knobs?.staged.size ?? 0;
    element('apply').textContent = words.apply(n);
    for (const id of ['apply', 'discard']) /** @type {HTMLButtonElement} */ (element(id)).disabled = n === 0;
  };
  knobs?.onstaged();
  if (knobs) {
    knobs.onundo = () => { /** @type {HTMLButtonElement} */ (element('undo')).disabled = knobs?.before.length === 0; };
    knobs.onundo();
  }
  listed = '';
  if (saved) for (const one of plots) for (const curve of link.saved) place(one, curve, true);
  asked = false;
  resize();
}

/** @param {string} text @param {() => void} act @param {boolean} [pressed] */
function button(text, act, pressed) {
  const made = document.createElement('button');
  made.type = 'button';
  made.textContent = text;
  made.onclick = act;
  if (pressed !== undefined) made.setAttribute('aria-pressed', String(pressed));
  return made;
}

/** Signal, case and layer of a curve. @param {number} curve */
function parts(curve) {
  const signals = hello.signals.length, cases = hello.cases.length;
  return { signal: curve % signals, case: Math.floor(curve / signals) % cases, layer: Math.floor(curve / signals / cases) };
}

/** A curve of a saved report belongs to every canvas that has its signal. @param {any} one @param {any} curve @param {boolean} fromFile */
function place(one, curve, fromFile) {
  const { signal } = parts(curve.curve), { signals, against } = one.canvas;
  const numbers = (/** @type {(number | null)[]} */ all) => Float64Array.from(all, x => x ?? NaN);
  if (!fromFile || !signals.includes(signal)) return;
  const y = numbers(curve.y);
  if (against === null) {
    one.curves.set(curve.curve, { x: numbers(curve.x), y });
  } else {
    const other = link.saved?.find((/** @type {any} */ c) => c.curve === curve.curve - signal + against);
    if (other) one.curves.set(curve.curve, { x: numbers(other.y), y });
  }
}

/** Colour and dashes: cases differ in colour where there are several, signals otherwise. @param {any} canvas @param {number} curve */
function look(canvas, curve) {
  const { signal, case: at, layer } = parts(curve), several = hello.cases.length > 1;
  const order = canvas.signals.indexOf(signal);
  const base = layer === baseLayer();
  if (!base && layer === 0) return { colour: '--ghost', dash: [5, 4], ghost: true };
  const own = several ? COLOURS[at % 4] : COLOURS[order % 4];
  const dash = several ? DASHES[(order + Math.floor(at / 4)) % 4] : DASHES[Math.floor(order / 4) % 4];
  return { colour: own, dash: base ? dash : layer === 2 ? [9, 4] : [3, 3], ghost: !base };
}

/** The layer of the latest run; a recording has one layer. */
function baseLayer() {
  return hello.kind === 'what if' ? 1 : 0;
}

/** @param {{ plot: Plot, canvas: any }} one */
function names(one) {
  const { canvas, plot } = one, several = hello.cases.length > 1;
  const entries = canvas.signals.flatMap((/** @type {number} */ signal) => hello.cases.map((/** @type {string} */ label, /** @type {number} */ at) => ({ signal, label, at })));
  plot.names.replaceChildren(...entries.map((/** @type {any} */ entry) => {
    const item = document.createElement('li'), line = document.createElement('canvas'), value = document.createElement('b');
    line.className = 'sample';
    line.setAttribute('aria-hidden', 'true');
    const curve = (baseLayer() * hello.cases.length + entry.at) * hello.signals.length + entry.signal;
    const { label, unit } = hello.signals[entry.signal];
    const over = canvas.against === null ? label : words.plane(label, hello.signals[canvas.against].label);
    const name = several && entry.label ? `${over}, ${entry.label}` : over;
    item.append(line, `${name} `, value, unit ? ` ${unit}` : '');
    item.dataset.curve = String(curve);
    const style = look(canvas, curve);
    requestAnimationFrame(() => sample(line, style.colour, style.dash));
    return item;
  }));
}

/** All there is. @returns {[number, number]} */
function all() {
  return [state?.from ?? hello.from, Math.max(end, state?.to ?? hello.to)];
}

/** The window that is shown. @returns {[number, number]} */
function span() {
  const [from, to] = all();
  // What is shorter fills the picture.
  return newest ? [Math.min(Math.max(from, to - newest), to - 1e-3), to] : window_ ?? [from, to];
}

/** Asks for the curves of all canvases, once they have their size. */
function ask() {
  plots.forEach((one, id) => {
    const { signals, against } = one.canvas, at = newest ? `last ${newest}` : window_ ? `${window_[0]} ${window_[1]}` : 'all';
    if (against === null) link.send(`view ${id} ${signals.join(',')} ${at} ${one.plot.columns()}`);
    else link.send(`path ${id} ${against},${signals[0]} ${at}`);
  });
  asked = true;
}

/** @param {[number, number] | null} to */
function move(to) {
  const [from, last] = all(), least = 1e-6 * (last - from);
  if (to) {
    const width = Math.min(Math.max(to[1] - to[0], least), last - from);
    const begin = Math.min(Math.max(to[0], from), last - width);
    // While more comes, all is more and more: a window stands.
    to = width >= last - from && !state?.grows ? null : [begin, begin + width];
  }
  window_ = to;
  if (newest) before = newest;
  newest = null;
  asked = false;
  wake();
}

/** Follows the newest, this long. @param {number} seconds */
function now(seconds) {
  newest = Math.min(Math.max(seconds, 1e-3), 1e6);
  window_ = null;
  asked = false;
  wake();
}

/** Back to the begin: the newest of what still grows, otherwise all. */
function home() {
  if (state?.grows) now(LAST); else move(null);
}

/** Holds the picture while more comes; and lets it go on. */
function hold() {
  if (newest) move(span()); else if (state?.grows) now(before);
}

/** @param {number} factor @param {number} [about] */
function zoom(factor, about) {
  if (newest) return now(newest * factor);
  const [from, to] = span(), middle = about ?? (from + to) / 2;
  move([middle - (middle - from) * factor, middle + (to - middle) * factor]);
}

/** @param {Plot} plot */
function follow(plot) {
  const canvas = plot.marks;
  const x = (/** @type {MouseEvent} */ event) => event.clientX - canvas.getBoundingClientRect().left;
  let /** @type {{ x: number, span: [number, number] } | null} */ held = null;
  canvas.onwheel = event => {
    if (!event.ctrlKey && Math.abs(event.deltaX) > Math.abs(event.deltaY)) return;
    event.preventDefault();
    zoom(Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY * 0.002))), plot.fromX(x(event)));
  };
  canvas.onpointerdown = event => { held = { x: x(event), span: span() }; canvas.setPointerCapture(event.pointerId); };
  canvas.onpointerup = () => { held = null; };
  canvas.onpointermove = event => {
    if (held) {
      const by = plot.fromX(held.x) - plot.fromX(x(event));
      if ((window_ || newest) && by !== 0) move([held.span[0] + by, held.span[1] + by]);
    }
    pointer = plot.fromX(x(event));
    wake();
  };
  canvas.onpointerleave = () => { pointer = null; wake(); };
  canvas.ondblclick = home;
}

function events() {
  const happened = state?.events ?? [], late = state?.late;
  element('events').hidden = hello.kind === 'what if';
  if (JSON.stringify(happened) !== listed) list(happened);
  element('late').hidden = !late;
  if (late) {
    element('late-name').textContent = words.late;
    bars(element('bars'), late, hello.period);
    element('late-words').textContent = words.lateWords(late);
  }
}
/** The answer that was shown last. */
let answered = 0;
/** The events that are listed, as text. */
let listed = '';

/** @param {any[]} happened */
function list(happened) {
  listed = JSON.stringify(happened);
  element('happened').replaceChildren(...happened.map((/** @type {any} */ event) => {
    const item = document.createElement('li'), made = button('', () => {
      const width = Math.min((all()[1] - all()[0]) / 4, 2);
      move([event.t - width / 2, event.t + width / 2]);
    });
    const time = document.createElement('b');
    time.textContent = `${number(event.t, 6)} s`;
    made.append(time, event.text);
    item.append(made);
    return item;
  }));
  if (!happened.length) element('happened').textContent = words.nothing;
}

/** Shows what the panel says of itself. */
function show() {
  if (!hello || !state) return;
  document.body.classList.remove('lost');
  if (hello.kind !== 'rig' || state.problem) problem(state.problem ?? null);
  if (hello.kind !== 'what if') {
    const rig = hello.kind === 'rig', asked = /^ended as asked/.test(state.over ?? '');
    const bad = rig && (state.over ? !asked : /^(stopped|refused|quick stop|torque off)/.test(state.stage));
    sentence(bad ? 'bad' : rig && state.stage !== 'armed' ? 'old' : 'good', rig ? words.rig(state) : words.recording(state));
    if (rig) {
      steps();
      if (state.answer && state.answer.number !== answered) {
        answered = state.answer.number;
        if (state.answer.refused) problem(words.answered(state.answer));
      }
    }
    events();
    if (newest && hello.grows && state.grows === false) move(span());
  } else {
    const failures = state.run?.failures ?? [];
    const failed = failures.length > 0 || (state.run?.verdicts ?? []).some((/** @type {any} */ v) => !v.holds);
    sentence(failed ? 'bad' : 'good', failures.length ? words.failed(failures) : words.running(hello, state.run));
  }
  knobs?.follow(state.values);
  if (knobs && hello.kind === 'what if') {
    knobs.live = state.short;
    input('set').value = state.set || words.none;
    /** @type {HTMLButtonElement} */ (element('copied')).disabled = !state.set;
    /** @type {HTMLButtonElement} */ (element('text')).disabled = !state.set;
    element('kept').replaceChildren(...['A', 'B'].flatMap((letter, i) => [
      button(words.keep(letter), () => say(`keep ${letter}`, problem)),
      ...(state.kept[i] ? [button(words.go(letter), () => { knobs?.touch(-2); knobs?.release(); say(`go ${letter}`, problem); })] : []),
    ]));
  }
  const verdicts = state.run?.verdicts ?? [];
  element('verdicts').hidden = verdicts.length === 0;
  const before = document.activeElement;
  element('judged').replaceChildren(...verdicts.map((/** @type {any} */ verdict) => {
    const item = document.createElement('li'), text = document.createElement('span');
    item.className = verdict.shown ? 'plain' : verdict.holds ? 'yes' : 'no';
    item.textContent = verdict.case ? `${verdict.case}: ${verdict.text}` : verdict.text;
    text.textContent = verdict.words;
    item.append(text);
    return item;
  }));
  if (before instanceof HTMLElement && document.activeElement !== before) before.focus();
  legend();
  wake();
}

/** What the ghosts are. */
function legend() {
  const place = element('legend');
  const shown = state.layers.map((/** @type {boolean} */ drawn, /** @type {number} */ layer) => ({ drawn, layer })).filter((/** @type {any} */ one) => one.drawn && words.drawn[one.layer] && hello.kind === 'what if');
  place.replaceChildren(...shown.map((/** @type {any} */ one) => {
    const item = document.createElement('span'), line = document.createElement('canvas');
    line.className = 'sample';
    line.setAttribute('aria-hidden', 'true');
    item.append(line, words.drawn[one.layer]);
    const dash = one.layer === 0 ? [5, 4] : one.layer === 2 ? [9, 4] : [3, 3];
    requestAnimationFrame(() => sample(line, one.layer === 0 ? '--ghost' : '--c0', dash));
    return item;
  }));
}

function wake() {
  if (!dirty) {
    dirty = true;
    requestAnimationFrame(draw);
  }
}

function resize() {
  let changed = false;
  plots.forEach(one => { changed = one.plot.fit() || changed; });
  if (changed) asked = false;
  if (state?.late) bars(element('bars'), state.late, hello.period);
  wake();
}

let drawnAt = 0;
const calm = matchMedia('(prefers-reduced-motion: reduce)');

function draw() {
  dirty = false;
  const now = performance.now();
  if (calm.matches && now - drawnAt < 250) {
    dirty = true;
    setTimeout(() => requestAnimationFrame(draw), 250);
    return;
  }
  drawnAt = now;
  if (!hello) return;
  let last = -1;
  for (const buffer of frames) {
    const frame = decode(buffer, hello.period ?? 0);
    last = frame.number;
    end = frame.newest;
    for (const curve of frame.curves) {
      const curves = plots[curve.view]?.curves;
      curves?.set(curve.curve, joined(curves.get(curve.curve), curve, span()[0]));
    }
  }
  frames = [];
  if (!asked && !saved) ask();
  if (state) plots.forEach(picture);
  if (cursors) measure();
  if (last >= 0) link.send(`ack ${last}`);
  // The sentences for screen readers change at most twice a second, and once at the end.
  if (now - told > 500) tell(); else { clearTimeout(telling); telling = setTimeout(tell, 500); }
}
let /** @type {any} */ telling = 0;

/** @param {{ plot: Plot, canvas: any, curves: Map<number, any> }} one */
function picture(one) {
  const { plot, canvas } = one, lines = [];
  if (plot.width === 0) return;
  for (const [number, curve] of one.curves) {
    const { signal, layer } = parts(number);
    // A frame that was on its way when the experiment changed may hold curves of other canvases.
    if (!state.layers[layer] || !canvas.signals.includes(signal)) continue;
    lines.push({ ...curve, ...look(canvas, number), step: hello.signals[signal].boolean, layer });
  }
  // The latest run on top.
  lines.sort((a, b) => Number(b.ghost) - Number(a.ghost));
  plot.draw(lines, plot.plane ? null : span());
  if (!plot.plane) plot.drawMarks(pointer, state.events ?? [], cursorTimes() ?? []);
  for (const item of plot.names.children) {
    const own = /** @type {HTMLElement} */ (item), curve = one.curves.get(Number(own.dataset.curve)), value = own.querySelector('b');
    if (!curve || !value) continue;
    const at = plot.plane ? curve.y[curve.y.length - 1] : valueAt(curve, pointer ?? span()[1]);
    const text = number(at, 4);
    if (value.textContent !== text) value.textContent = text;
  }
}

/** The times of the cursors, the earlier first. @returns {[number, number] | null} */
function cursorTimes() {
  if (!cursors) return null;
  const [from, to] = span(), at = cursors.map(part => from + part * (to - from));
  return [Math.min(...at), Math.max(...at)];
}

function toggleCursors() {
  cursors = cursors ? null : [1 / 3, 2 / 3];
  const place = element('cursors');
  place.hidden = !cursors;
  element('measure').setAttribute('aria-pressed', String(!!cursors));
  if (cursors) {
    place.replaceChildren(...cursors.map((part, i) => {
      const slider = document.createElement('input');
      slider.type = 'range';
      slider.max = '1000';
      slider.value = String(Math.round(1000 * part));
      slider.setAttribute('aria-label', words.cursor(i + 1));
      slider.onkeydown = event => event.stopPropagation();
      slider.oninput = () => {
        if (cursors) cursors[i] = Number(slider.value) / 1000;
        wake();
      };
      return slider;
    }), document.createElement('table'));
  }
  wake();
}

/** What lies between the cursors: extremes are those of all points, as every column keeps its own. */
function measure() {
  const times = cursorTimes(), made = element('cursors').querySelector('table');
  if (!times || !made) return;
  const [from, to] = times, fresh = document.createElement('table');
  const head = fresh.createTHead().insertRow();
  for (const name of [words.between(from, to), ...words.measures]) {
    const cell = document.createElement('th');
    cell.scope = 'col';
    cell.textContent = name;
    head.append(cell);
  }
  const body = fresh.createTBody();
  for (const one of plots.filter(one => !one.plot.plane)) {
    for (const [curve, { x, y }] of one.curves) {
      const { signal, case: at, layer } = parts(curve);
      if (layer !== baseLayer()) continue;
      const first = valueAt({ x, y }, from), last = valueAt({ x, y }, to);
      let low = Math.min(first, last), high = Math.max(first, last);
      for (let i = 0; i < x.length; i++) {
        if (x[i] < from || x[i] > to) continue;
        if (y[i] < low) low = y[i];
        if (y[i] > high) high = y[i];
      }
      const row = body.insertRow(), { label, unit } = hello.signals[signal];
      row.insertCell().textContent = [label, hello.cases[at], unit && `in ${unit}`].filter(Boolean).join(' ');
      for (const value of [last - first, low, high, high - low]) row.insertCell().textContent = number(value, 5);
    }
  }
  made.replaceWith(fresh);
}

/** Sums up each canvas for those who cannot see it. */
function tell() {
  told = performance.now();
  if (!hello) return;
  for (const one of plots) {
    const texts = one.canvas.signals.flatMap((/** @type {number} */ signal) => hello.cases.map((/** @type {string} */ label, /** @type {number} */ at) => {
      const curve = one.curves.get((baseLayer() * hello.cases.length + at) * hello.signals.length + signal);
      const name = [hello.signals[signal].label, label].filter(Boolean).join(', ');
      let low = Infinity, high = -Infinity;
      for (let i = 0; i < (curve?.y.length ?? 0); i++) {
        const y = curve.y[i];
        if (y < low) low = y;
        if (y > high) high = y;
      }
      const end = curve ? curve.y[curve.y.length - 1] : NaN;
      return words.summary(name, hello.signals[signal].unit, [...span(), low, high, end]);
    }));
    one.plot.tell(texts.join('; '));
  }
  if (!element('table').hidden) table();
}

/** Values at 21 instants of the window. */
function table() {
  const [from, to] = span(), rows = [], times = plots.filter(one => !one.plot.plane);
  const columns = times.flatMap(one => [...one.curves].filter(([curve]) => parts(curve).layer === baseLayer()).map(([curve, points]) => ({ curve, points })));
  const made = document.createElement('table'), head = made.createTHead().insertRow();
  for (const name of [words.time, ...columns.map(({ curve }) => {
    const { signal, case: at } = parts(curve), { label, unit } = hello.signals[signal];
    return [label, hello.cases[at], unit && `in ${unit}`].filter(Boolean).join(' ');
  })]) {
    const cell = document.createElement('th');
    cell.scope = 'col';
    cell.textContent = name;
    head.append(cell);
  }
  for (let i = 0; i <= 20; i++) rows.push(from + (to - from) * i / 20);
  const body = made.createTBody();
  for (const t of rows) {
    const row = body.insertRow();
    for (const value of [t, ...columns.map(({ points }) => valueAt(points, t))]) row.insertCell().textContent = number(value, 5);
  }
  element('cells').replaceChildren(made);
}

function toggleTable() {
  const place = element('table');
  place.hidden = !place.hidden;
  element('values').setAttribute('aria-pressed', String(!place.hidden));
  if (!place.hidden) {
    table();
    place.focus();
    place.scrollIntoView({ block: 'nearest' });
  }
}

function start() {
  element('curves-name').textContent = words.curves;
  element('knobs-name').textContent = words.parameters;
  element('side').setAttribute('aria-label', words.side);
  element('verdicts-name').textContent = words.expected;
  element('events-name').textContent = words.events;
  element('table-name').textContent = words.table;
  element('keys').textContent = words.keys;
  element('stop').textContent = words.stop;
  element('stop').onclick = stop;
  element('next').onclick = next;
  element('apply').onclick = () => knobs?.apply();
  element('discard').textContent = words.discard;
  element('discard').onclick = () => knobs?.discard();
  element('undo').textContent = words.undo;
  element('undo').onclick = () => knobs?.undo();
  element('text').textContent = words.asText;
  element('text').onclick = () => { knobs?.touch(-2); knobs?.release(); say('go text', problem); };
  element('copy-name').textContent = words.set;
  element('copied').textContent = words.copy;
  element('copied').onclick = async () => {
    input('set').select();
    await navigator.clipboard?.writeText(input('set').value).then(() => {
      element('copied').textContent = words.copied;
      setTimeout(() => { element('copied').textContent = words.copy; }, 1500);
    }, () => {});
  };
  const tools = element('tools'), values = button(words.values, toggleTable, false), measures = button(words.cursors, toggleCursors, false), shown = document.createElement('span');
  tools.setAttribute('aria-label', words.tools);
  values.id = 'values';
  measures.id = 'measure';
  shown.id = 'legend';
  shown.className = 'legend';
  tools.append(button(words.whole, () => move(null)), button(words.newest, home), button(words.closer, () => zoom(0.5)), button(words.wider, () => zoom(2)), values, measures, shown);
  addEventListener('keydown', event => {
    const target = /** @type {HTMLElement} */ (event.target);
    if (event.key === 'Escape' && hello?.kind === 'rig') return stop();
    if (!hello || event.ctrlKey || event.metaKey || event.altKey || target.tagName === 'INPUT' && /** @type {HTMLInputElement} */ (target).type === 'text' || target.id === 'set') return;
    // A button takes its own space bar.
    if (event.key === ' ' && target.closest('button, input')) return;
    const [from, to] = span(), by = 0.2 * (to - from);
    const act = {
      '+': () => zoom(0.5), '=': () => zoom(0.5), '-': () => zoom(2), Home: home, ' ': hold, t: toggleTable, c: toggleCursors, u: () => knobs?.undo(),
      ArrowLeft: () => (window_ || newest) && move([from - by, to - by]), ArrowRight: () => window_ && move([from + by, to + by]),
    }[event.key];
    if (act) {
      event.preventDefault();
      act();
    }
  });
  new ResizeObserver(resize).observe(element('curves'));
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => { plots.forEach(names); if (state) legend(); resize(); wake(); });
  addEventListener('beforeprint', resize);
}
start();
