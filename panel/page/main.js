// Puts the page together.
import { words, number } from './words.js';
import { decode, connect, embedded, joined } from './link.js';
import { Plot, COLOURS, DASHES, sample, valueAt, bars } from './plot.js';
import { Knobs } from './knobs.js';

/** Seconds that are shown of what still grows, and at most in the plane. */
const LAST = 20, PHASE = 10;
/** How far the picture is behind the newest data, s: these come ten times a second, and the picture moves evenly. */
const BEHIND = 0.25;
/** Least time between two pictures of what moves, ms: the browser then takes the next of its own. */
const EACH = 12;
/** Least time between two texts of the values of what moves, ms. */
const NAMED = 200;

const element = (/** @type {string} */ id) => /** @type {HTMLElement} */ (document.getElementById(id));
const control = (/** @type {string} */ id) => /** @type {HTMLButtonElement} */ (document.getElementById(id));
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
/** The right edge of the moving picture, s, at an instant, ms. */
let edge = 0, edgeAt = 0, connected = false;
/** When newer data came last, ms. */
let endAt = 0;
/** @type {{ plot: Plot, canvas: any, curves: Map<number, any> }[]} */
let plots = [];
let /** @type {Knobs | null} */ knobs = null;
let /** @type {number | null} */ pointer = null;
/** Two cursors as parts of the window; null: off. @type {[number, number] | null} */
let cursors = null;
/** Frames that wait to be drawn. @type {ArrayBuffer[]} */
let frames = [];
const calm = matchMedia('(prefers-reduced-motion: reduce)');
let dirty = false, asked = false, told = 0;
/** Measures of curves between the cursors, as the panel has computed them from all points. @type {Map<number, (number | null)[]>} */
const measured = new Map();
/** What they were asked for, and when. */
let measuredFor = '', measuredAt = 0;
/** Frames with curves so far. */
let fresh = 0;
/** A rule that moves the window. @type {{ curve: number, way: string, level: number, mode: string, place: number, after: number, asked: number, at: number | null, since: number } | null} */
let trigger = null;
let questions = 0;
/** Whether the model beside a rig runs on from arming, and not anew from each full state. */
let free = false;
/** Whether a layer of a rig is drawn. @param {number} layer */
const drawn = layer => hello.kind === 'what if' || layer === 0 || layer === 3 || layer === (free || !state.layers[2] ? 1 : 2);
/** What to do with refusals, by the number of the line. @type {Map<number, (why: string) => void>} */
const refusals = new Map();
/** The same by the number under which a rig answers. @type {Map<number, (why: string) => void>} */
const ofRig = new Map();

const saved = document.getElementById('data');
const link = saved ? embedded(JSON.parse(saved.textContent ?? '{}'), message) : connect(buffer => { frames.push(buffer); wake(); }, message, lost);

/** The number of this page; whether it came through the link for others. */
let me = 0, guest = false;
/** Whether the commands of this page count: nobody else operates the rig. */
const operates = () => !guest && (!state?.chair?.holder || state.chair.holder === me);

/** @param {any} what */
function message(what) {
  if (what.kind === 'hello') {
    if (me !== what.page) answered = 0;
    [me, guest] = [what.page, what.guest];
    begin(what.is);
  }
  if (what.kind === 'state') { state = what.is; show(); }
  if (what.kind === 'measures') {
    what.curves.forEach((/** @type {number} */ curve, /** @type {number} */ i) => measured.set(curve, what.measures[i]));
    wake();
  }
  if (what.kind === 'csv') written(what);
  if (what.kind === 'found' && what.number === trigger?.asked) found(what.t);
  if (what.kind === 'answer') {
    const refuse = refusals.get(what.number);
    refusals.delete(what.number);
    if (what.refused) (refuse ?? (why => problem(why)))(what.refused);
    else if (hello?.kind === 'rig') {
      problem(null);
      if (refuse && refuse !== problem && what.ok) ofRig.set(Number(what.ok), refuse);
      if (ofRig.size > 100) ofRig.delete(ofRig.keys().next().value ?? 0);
    }
  }
}

/** The right edge of the moving picture now, s. */
function edgeNow() {
  return Math.min(end, edge + (performance.now() - edgeAt) / 1000);
}

/** Newer data have come: the edge keeps its pace, and is drawn towards them. */
function pace() {
  const goal = end - BEHIND, now = edgeNow(), off = goal - now;
  edge = calm.matches ? end : Math.abs(off) > 1 ? goal : now + 0.1 * off;
  edgeAt = performance.now();
}

/** @param {string} why */
function lost(why) {
  connected = false;
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
  if (step === 'again') say('again', problem);
  steps();
}

function steps() {
  const step = /** @type {'enable' | 'arm' | 'again' | '-'} */ (state?.next ?? '-'), place = element('next'), sure = performance.now() < sureUntil;
  place.hidden = hello?.kind !== 'rig' || step === '-' || !!saved || guest;
  /** @type {HTMLButtonElement} */ (place).disabled = !operates();
  if (step === '-') return;
  place.textContent = (sure ? words.sure : words.next)[step];
  place.classList.toggle('sure', sure);
}

/** Who operates, and what this page can do about it. */
function chair() {
  const place = element('chair'), { holder = null, asks = null, refused = null } = state?.chair ?? {};
  const mine = holder === me, [text, ...acts] = guest ? [words.guest]
    : holder === null ? ['']
      : mine ? asks ? [words.asksYou(asks), 'refuse', 'give'] : [words.youOperate(me)]
        : asks === me ? [words.asked(holder)]
          : [refused === me ? words.refusedYou(holder) : words.operates(holder), 'take'];
  place.hidden = text === '' || hello?.kind !== 'rig' || !!saved;
  place.classList.toggle('asked', mine && !!asks && !guest);
  const shown = `${text} ${acts}`;
  if (place.dataset.shown === shown) return;
  place.dataset.shown = shown;
  place.replaceChildren(text, ...acts.map(act => button(words[/** @type {'take' | 'refuse' | 'give'} */ (act)], () => say(act, problem))));
}

/** What was kept of a rig under a letter: the values of its parameters, the window, and its curves by what they stand over. @type {Map<string, { texts: string[], span: [number, number], curves: any[], shown: boolean }>} */
const keptOf = new Map();

/** Keeps the values in effect and the curves that are shown. @param {string} letter */
function keepAs(letter) {
  const [from, to] = span(), curves = plots.flatMap(({ canvas: { signals, against }, curves }) => [...curves].filter(([signal]) => signals.includes(signal)).map(([signal, { x, y }]) => {
    // As they are now: a later frame adds to them.
    const all = [...x.keys()].filter(i => against !== null || x[i] >= from && x[i] <= to);
    return { signal, against, x: Float64Array.from(all, i => x[i]), y: Float64Array.from(all, i => y[i]) };
  }));
  keptOf.set(letter, { texts: [...state.texts], span: [from, to], curves, shown: true });
  keeps(true);
  legend();
  wake();
}

/** The curves that were kept, over what is shown: they stand still, with the right edge of their window at that of this one. @param {any} one @param {string} letter @param {any} kept */
function ghosts(one, letter, kept) {
  const { signals, against } = one.canvas, by = span()[1] - kept.span[1];
  return kept.curves.filter((/** @type {any} */ curve) => signals.includes(curve.signal) && curve.against === against).map((/** @type {any} */ curve) => ({
    ...curve, ...look(one.canvas, curve.signal), dash: KEPT_DASHES[letter], ghost: true, still: true, curve: -1, step: hello.signals[curve.signal].boolean, layer: 0, by: against === null ? by : 0,
  }));
}
/** @type {Record<string, number[]>} */
const KEPT_DASHES = { A: [9, 4], B: [3, 3] };

/** Two sets of values of a rig, to go back and forth: they are prepared, and sent by Apply. */
function keeps(anew = false) {
  const text = state.set || words.none, place = element('kept');
  if (input('set').value !== text) input('set').value = text;
  control('copied').disabled = !state.set;
  if (place.childElementCount > 0 && !anew) return;
  renew(place, ['A', 'B'].flatMap(letter => {
    const kept = keptOf.get(letter);
    return [button(words.keep(letter), () => keepAs(letter)), ...kept ? [
      button(words.goStaged(letter), () => knobs?.prepare(kept.texts, state.texts)),
      button(words.ghost(letter), () => {
        kept.shown = !kept.shown;
        keeps(true);
        legend();
        wake();
      }, kept.shown),
    ] : []];
  }));
}

/** The answers of the rig to this page. */
function answers() {
  for (const answer of state.answers ?? []) {
    if (answer.page !== me || answer.number <= answered) continue;
    answered = answer.number;
    const place = element('taken');
    if (answer.refused) problem(words.answered(answer));
    // Also beside the parameter.
    if (answer.refused) ofRig.get(answer.number)?.(answer.refused);
    ofRig.delete(answer.number);
    place.hidden = !!answer.refused || answer.cycle === null;
    if (!place.hidden) place.textContent = words.taken(answer);
  }
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
  measured.clear();
  if (trigger) toggleTrigger();
  window_ = null;
  newest = hello.grows ? LAST : null;
  end = edge = hello.to;
  edgeAt = performance.now();
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
  const times = overTime();
  times.forEach(one => {
    one.plot.title = words.time;
    follow(one.plot);
  });
  plots.filter(one => one.plot.plane).forEach(presses);
  plots.forEach(names);
  watcher.disconnect();
  seen.clear();
  plots.forEach(one => watcher.observe(one.plot.root));
  const unit = element('knobs');
  unit.hidden = hello.knobs.length === 0 || !!saved;
  const rig = hello.kind === 'rig';
  slots();
  knobs = unit.hidden ? null : new Knobs(element('rows'), hello.knobs, rig ? command : say, rig);
  for (const id of ['undo', 'text']) element(id).hidden = rig;
  keptOf.clear();
  element('kept').replaceChildren();
  element('taken').hidden = true;
  element('kept').hidden = guest;
  element('stages').hidden = !rig || guest;
  element('marks').hidden = !rig || !!saved || guest;
  element('stop').hidden = !rig || !!saved;
  if (knobs) knobs.onstaged = () => {
    const n = knobs?.staged.size ?? 0;
    element('apply').textContent = words.apply(n);
    for (const id of ['apply', 'discard']) control(id).disabled = n === 0 || id === 'apply' && !operates();
  };
  if (guest) for (const one of element('rows').querySelectorAll('input')) one.disabled = true;
  knobs?.onstaged();
  if (knobs) {
    knobs.onundo = () => { control('undo').disabled = knobs?.before.length === 0; };
    knobs.onundo();
  }
  listed = '';
  if (saved) for (const one of plots) for (const curve of link.saved) placed(one, curve, true);
  asked = false;
  resize();
}

/** @param {string} name @param {Node[]} of */
function group(name, ...of) {
  const made = document.createElement('div');
  made.setAttribute('role', 'group');
  made.setAttribute('aria-label', name);
  made.append(...of);
  return made;
}

/** Replaces what is in a place; a button with the same text keeps the focus. @param {HTMLElement} place @param {Node[]} made */
function renew(place, made) {
  const focus = place.contains(document.activeElement) && document.activeElement?.textContent;
  place.replaceChildren(...made);
  if (focus) [...place.querySelectorAll('button')].find(one => one.textContent === focus)?.focus();
}

/** @param {Element} button @param {boolean} is */
const press = (button, is) => button.setAttribute('aria-pressed', String(is));

/** @param {string} text @param {() => void} act @param {boolean} [pressed] */
function button(text, act, pressed) {
  const made = document.createElement('button');
  made.type = 'button';
  made.textContent = text;
  made.onclick = act;
  if (pressed !== undefined) press(made, pressed);
  return made;
}

/** Signal, case and layer of a curve. @param {number} curve */
function parts(curve) {
  const signals = hello.signals.length, cases = hello.cases.length;
  return { signal: curve % signals, case: Math.floor(curve / signals) % cases, layer: Math.floor(curve / signals / cases) };
}

/** A curve of a saved report belongs to every canvas that has its signal. @param {any} one @param {any} curve @param {boolean} fromFile */
function placed(one, curve, fromFile) {
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
  if (layer === 3 && hello.kind !== 'what if') return { colour: '--faint', dash: [2, 3], ghost: true };
  if (!base && (layer === 0 || hello.kind !== 'what if')) return { colour: '--ghost', dash: [5, 4], ghost: true };
  const own = several ? COLOURS[at % 4] : COLOURS[order % 4];
  const dash = several ? DASHES[(order + Math.floor(at / 4)) % 4] : DASHES[Math.floor(order / 4) % 4];
  return { colour: own, dash: base ? dash : layer === 2 ? [9, 4] : [3, 3], ghost: !base };
}

/** The layer of the latest run; a recording has one layer. */
function baseLayer() {
  return hello.kind === 'what if' ? 1 : 0;
}

/** The models that fit each slot, one press each. */
function slots() {
  renew(element('models'), (saved ? [] : hello.slots ?? []).map((/** @type {any} */ slot, /** @type {number} */ at) => {
    const name = document.createElement('b');
    name.textContent = slot.path;
    return group(words.slot(slot.path, slot.interface), name, ...slot.fits.map((/** @type {string} */ model) => {
      const made = button(model, () => say(`slot ${slot.path} = ${model}`, problem), false);
      made.dataset.slot = String(at);
      return made;
    }));
  }));
}

/** A canvas in the plane of a contact shows its force over speed or position, or its speed over position: one press each. @param {{ plot: Plot, canvas: any, curves: Map<number, any> }} one */
function presses(one) {
  const { canvas, plot } = one, phase = (hello.phases ?? []).find((/** @type {any} */ of) => of.speed === canvas.against && of.force === canvas.signals[0]);
  plot.title = hello.signals[canvas.against].unit;
  if (!phase || phase.position === null) return;
  const label = (/** @type {number} */ signal) => hello.signals[signal].label;
  const made = [[phase.force, phase.speed], [phase.force, phase.position], [phase.speed, phase.position]].map(([y, x]) => button(words.plane(label(y), label(x)), () => {
    one.canvas = { signals: [y], against: x };
    one.curves.clear();
    [plot.empty, plot.title] = [true, hello.signals[x].unit];
    made.forEach(other => press(other, other.textContent === words.plane(label(y), label(x))));
    names(one);
    if (saved) for (const curve of link.saved) placed(one, curve, true);
    asked = false;
    tell();
    wake();
  }, y === canvas.signals[0] && x === canvas.against));
  const place = group(words.plane(label(phase.force), label(phase.speed)), ...made);
  place.className = 'presses';
  plot.root.prepend(place);
}

/** @param {{ plot: Plot, canvas: any }} one */
function names(one) {
  const { canvas, plot } = one, several = hello.cases.length > 1;
  const entries = canvas.signals.flatMap((/** @type {number} */ signal) => hello.cases.map((/** @type {string} */ label, /** @type {number} */ at) => ({ signal, label, at })));
  plot.names.replaceChildren(...entries.map((/** @type {any} */ entry) => {
    const item = document.createElement('li'), value = document.createElement('b');
    const curve = (baseLayer() * hello.cases.length + entry.at) * hello.signals.length + entry.signal;
    const { label, unit } = hello.signals[entry.signal];
    const over = canvas.against === null ? label : words.plane(label, hello.signals[canvas.against].label);
    const name = several && entry.label ? `${over}, ${entry.label}` : over;
    const rms = document.createElement('small');
    item.append(sampled(look(canvas, curve)), `${name} `, value, unit ? ` ${unit}` : '', rms);
    item.dataset.curve = String(curve);
    return item;
  }));
}

/** Canvases over time. */
const overTime = () => plots.filter(one => !one.plot.plane);

/** A curve with its unit, in words. @param {number} curve */
function titled(curve) {
  const { signal, case: at } = parts(curve), { label, unit } = hello.signals[signal];
  return [label, hello.cases[at], unit && `in ${unit}`].filter(Boolean).join(' ');
}

/** All there is. @returns {[number, number]} */
function all() {
  return [state?.from ?? hello.from, Math.max(end, state?.to ?? hello.to)];
}

/** The window that is shown. @returns {[number, number]} */
function span() {
  const [from, last] = all();
  if (!newest) return window_ ?? [from, last];
  const to = state?.grows ? edgeNow() : last;
  // What is shorter fills the picture.
  return [Math.min(Math.max(from, to - newest), to - 1e-3), to];
}

/** Asks for the curves of all canvases, once they have their size. */
function ask() {
  plots.forEach((one, id) => {
    const { signals, against } = one.canvas, at = newest ? `last ${lasts()}` : window_ ? `${window_[0]} ${window_[1]}` : 'all';
    if (against === null) link.send(`view ${id} ${signals.join(',')} ${at} ${one.plot.columns()}`);
    else link.send(`path ${id} ${against},${signals[0]} ${newest ? `last ${Math.min(lasts(), PHASE)}` : at}`);
  });
  askedFor = newest ? lasts() : 0;
  asked = true;
}

/** Seconds of the newest for which is asked: while there is less, columns are finer. */
function lasts() {
  const there = end - all()[0];
  let seconds = newest ?? 0;
  while (seconds / 2 > Math.max(there, 1)) seconds /= 2;
  return seconds;
}
/** For how many was asked. */
let askedFor = 0;

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
  standing();
  element('late').hidden = !late;
  if (late) {
    element('late-name').textContent = words.late;
    bars(element('bars'), late, hello.period);
    element('late-words').textContent = words.lateWords(late);
  }
}
/** Drives with their lights, commands within their limits. */
function standing() {
  const { drives = [], commands = [] } = state?.standing ?? {}, place = element('drives');
  element('standing').hidden = drives.length + commands.length === 0;
  element('standing-name').textContent = words.drives;
  const energy = element('energy');
  energy.hidden = !state?.energy;
  if (state?.energy) energy.textContent = words.energy(state.energy);
  energy.className = state?.energy && (state.energy.share > 1 || state.energy.unpredicted > 0) ? 'light bad' : '';
  if (place.children.length !== drives.length + commands.length) {
    place.replaceChildren(...[...drives, ...commands].map((_, i) => {
      const item = document.createElement('li'), text = document.createElement('span');
      item.append(text);
      if (i >= drives.length) {
        const meter = document.createElement('div');
        meter.className = 'meter';
        meter.setAttribute('role', 'meter');
        meter.append(document.createElement('i'));
        item.append(meter);
      }
      return item;
    }));
  }
  [...place.children].forEach((item, i) => {
    const text = item.querySelector('span'), drive = drives[i], command = commands[i - drives.length];
    const told = drive ? `${drive.name}: ${drive.words}` : words.of(command);
    item.className = drive ? `light ${drive.kind}` : '';
    if (text && text.textContent !== told) text.textContent = told;
    const meter = /** @type {HTMLElement | null} */ (item.querySelector('.meter'));
    if (meter) {
      const part = (/** @type {number} */ value) => 100 * Math.min(1, Math.max(0, (value - command.low) / (command.high - command.low)));
      const [zero, now] = [part(0), part(command.value)], bar = /** @type {HTMLElement} */ (meter.firstElementChild);
      [bar.style.left, bar.style.width] = [`${Math.min(zero, now)}%`, `max(2px, ${Math.abs(now - zero)}%)`];
      meter.setAttribute('aria-label', command.name);
      for (const [name, value] of [['min', command.low], ['max', command.high], ['now', command.value]]) meter.setAttribute(`aria-value${name}`, String(value));
    }
  });
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
  connected = true;
  document.body.classList.remove('lost');
  if (hello.kind !== 'rig' || state.problem) problem(state.problem ?? null);
  if (hello.kind !== 'what if') {
    const rig = hello.kind === 'rig', asked = /^ended as asked/.test(state.over ?? '');
    const bad = rig && (state.over ? !asked : /^(stopped|refused|quick stop|torque off)/.test(state.stage));
    sentence(bad ? 'bad' : rig && state.stage !== 'armed' ? 'old' : 'good', rig ? words.rig(state) : words.recording(state));
    if (rig) {
      steps();
      chair();
      answers();
      knobs?.onstaged();
      control('mark').disabled = !operates();
    }
    events();
    if (newest && hello.grows && state.grows === false) move(span());
  } else {
    const failures = state.run?.failures ?? [];
    const failed = failures.length > 0 || (state.run?.verdicts ?? []).some((/** @type {any} */ v) => !v.holds);
    sentence(failed ? 'bad' : 'good', failures.length ? words.failed(failures) : words.running(hello, state.run));
  }
  knobs?.follow(state.values);
  if (knobs && hello.kind === 'rig') keeps();
  if (knobs && hello.kind === 'what if') {
    knobs.live = state.short;
    input('set').value = state.set || words.none;
    control('copied').disabled = !state.set;
    control('text').disabled = !state.set;
    renew(element('kept'), ['A', 'B'].flatMap((letter, i) => [
      button(words.keep(letter), () => say(`keep ${letter}`, problem)),
      ...(state.kept[i] ? [button(words.go(letter), () => { knobs?.touch(-2); knobs?.release(); say(`go ${letter}`, problem); })] : []),
    ]));
  }
  for (const one of element('models').querySelectorAll('button')) {
    const there = state.models?.[Number(one.dataset.slot)] === one.textContent, place = one.parentElement;
    if (one.getAttribute('aria-pressed') === String(there) || !place) continue;
    press(one, there);
    // The model that is there is in sight.
    if (there) place.scrollTop = one.offsetTop - place.offsetTop - one.offsetHeight;
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
  const rig = hello.kind !== 'what if', [, once, anew, steady] = state.layers;
  if (rig) element('free').hidden = !(once && anew);
  const kept = rig ? [...keptOf.keys()].filter(letter => keptOf.get(letter)?.shown).sort() : ['A', 'B'].filter((_, i) => state.layers[2 + i]);
  explain([
    ...(rig ? once || anew : state.layers[0]) ? [{ text: !rig ? words.drawn : free || !anew ? words.twin : words.ahead, colour: '--ghost', dash: [5, 4] }] : [],
    ...rig && steady ? [{ text: words.steady, colour: '--faint', dash: [2, 3] }] : [],
    ...kept.map(letter => ({ text: letter, colour: '--c0', dash: KEPT_DASHES[letter] })),
  ]);
}

/** Shows lines beside their names. @param {{ text: string, colour: string, dash: number[] }[]} entries */
function explain(entries) {
  const place = element('legend');
  if (place.textContent !== entries.map(one => one.text).join('')) place.replaceChildren(...entries.map(one => {
    const item = document.createElement('span');
    item.append(sampled(one), one.text);
    return item;
  }));
}

/** The sample of a line. @param {{ colour: string, dash: number[] }} style */
function sampled(style) {
  const line = document.createElement('canvas');
  line.className = 'sample';
  line.setAttribute('aria-hidden', 'true');
  requestAnimationFrame(() => sample(line, style.colour, style.dash));
  return line;
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

/** Canvases in the window of the browser. @type {Set<Element>} */
const seen = new Set();
const watcher = new IntersectionObserver(entries => {
  for (const entry of entries) if (entry.isIntersecting) seen.add(entry.target); else seen.delete(entry.target);
  wake();
});
let printing = false;
let drawnAt = 0;

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
  if (frames.length) fresh += 1;
  for (const buffer of frames) {
    const frame = decode(buffer, hello.period ?? 0);
    last = frame.number;
    if (frame.newest !== end) {
      end = frame.newest;
      endAt = performance.now();
      pace();
    }
    for (const curve of frame.curves) {
      const curves = plots[curve.view]?.curves;
      const whole = joined(curves?.get(curve.curve), curve, span()[0]);
      curves?.set(curve.curve, whole);
      // Not only its end is new.
      if (whole === curve && plots[curve.view]) plots[curve.view].plot.moved = null;
    }
  }
  frames = [];
  if (!saved && (!asked || newest && askedFor !== lasts())) ask();
  // What nobody sees is not drawn.
  if (state) plots.filter(one => printing || seen.has(one.plot.root)).forEach(picture);
  seek();
  if (cursors) measure();
  if (last >= 0) link.send(`ack ${last}`);
  // A slow computer draws less often, and has time for its operator.
  if (newest && state?.grows && connected && !calm.matches && !document.hidden) setTimeout(wake, Math.max(EACH, 3 * (performance.now() - now)));
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
    if (!state.layers[layer] || !drawn(layer) || !canvas.signals.includes(signal)) continue;
    const fades = plot.plane && layer === 0 && !!newest && hello.kind !== 'what if';
    lines.push({ ...curve, ...look(canvas, number), curve: number, step: hello.signals[signal].boolean, layer, fades });
  }
  // The latest run on top.
  lines.sort((a, b) => Number(b.ghost) - Number(a.ghost));
  for (const [letter, kept] of keptOf) if (kept.shown) lines.push(...ghosts(one, letter, kept));
  plot.draw(lines, plot.plane ? null : span(), !plot.plane && !!newest && !!state.grows && !printing);
  if (!plot.plane) plot.drawMarks(pointer, state.events ?? [], [...cursorTimes() ?? [], ...trigger?.at ? [trigger.at] : []]);
  // Nobody reads numbers faster, and each new text is a new layout.
  const now = performance.now();
  if (newest && state.grows && pointer === null && now - plot.named < NAMED) return;
  plot.named = now;
  for (const item of plot.names.children) {
    const own = /** @type {HTMLElement} */ (item), curve = one.curves.get(Number(own.dataset.curve)), value = own.querySelector('b');
    if (!curve || !value) continue;
    const at = plot.plane ? curve.y[curve.y.length - 1] : valueAt(curve, pointer ?? span()[1]);
    const text = number(at, 4);
    if (value.textContent !== text) value.textContent = text;
    const rms = (free || !state.layers[2] ? state.rms : state.ahead)?.[Number(own.dataset.curve)], place = own.querySelector('small'), off = plot.plane || typeof rms !== 'number' ? '' : words.rms(rms);
    if (place && place.textContent !== off) place.textContent = off;
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
  press(element('measure'), !!cursors);
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
    }), ...saved ? [] : [button(words.csv, askCsv)], document.createElement('table'));
  }
  wake();
}

/** Asks for the measures of all points, now and then. @param {[number, number]} times @param {number[]} curves */
function askMeasures(times, curves) {
  const what = `${times} ${curves} ${fresh}`;
  if (saved || what === measuredFor || curves.length === 0) return;
  if (performance.now() - measuredAt < 250) return void setTimeout(wake, 250);
  measuredFor = what;
  measuredAt = performance.now();
  for (let i = 0; i < curves.length; i += 16) link.send(`between ${questions += 1} ${times[0]} ${times[1]} ${curves.slice(i, i + 16).join(',')}`);
}

/** What lies between the cursors. Extremes are those of all points, as every column keeps its own. */
function measure() {
  const times = cursorTimes(), made = element('cursors').querySelector('table');
  if (!times || !made || times[0] >= times[1]) return;
  const [from, to] = times, table = document.createElement('table');
  heads(table, [words.between(from, to), ...words.measures]);
  const body = table.createTBody(), curves = [];
  for (const one of overTime()) {
    for (const [curve, { x, y }] of one.curves) {
      const { signal, layer } = parts(curve);
      if (layer !== baseLayer()) continue;
      curves.push(curve);
      const first = valueAt({ x, y }, from), last = valueAt({ x, y }, to);
      let low = Math.min(first, last), high = Math.max(first, last);
      for (let i = 0; i < x.length; i++) {
        if (x[i] < from || x[i] > to) continue;
        if (y[i] < low) low = y[i];
        if (y[i] > high) high = y[i];
      }
      const known = measured.get(curve), row = body.insertRow(), { label, unit } = hello.signals[signal];
      const [min, max, mean, rms, peak, period] = known ?? [low, high, NaN, NaN, high - low, NaN];
      const name = titled(curve), copy = button(name, () => {
        void navigator.clipboard?.writeText(words.expect(label, `${number(peak ?? NaN, 5)} ${unit}`.trim(), from, to));
      });
      copy.setAttribute('aria-label', words.copyExpect(name));
      row.insertCell().append(copy);
      for (const value of [last - first, min, max, mean, rms, peak, period]) row.insertCell().textContent = number(value ?? NaN, 5);
    }
  }
  askMeasures(times, curves);
  // What stands there stays where it is, so that the focus does: only its texts change.
  const cells = (/** @type {HTMLElement} */ of) => [...of.querySelectorAll('th, td')], [before, after] = [cells(made), cells(table)];
  if (before.length !== after.length) return made.replaceWith(table);
  before.forEach((cell, i) => {
    const [old, own] = [cell.querySelector('button'), after[i].querySelector('button')];
    if (old && own) {
      old.onclick = own.onclick;
      if (old.textContent !== own.textContent) old.textContent = own.textContent;
      old.setAttribute('aria-label', own.getAttribute('aria-label') ?? '');
    } else if (cell.textContent !== after[i].textContent) cell.textContent = after[i].textContent;
  });
}

/** Asks for the points between the cursors, of all curves in the table. */
function askCsv() {
  const times = cursorTimes(), curves = overTime().flatMap(one => [...one.curves.keys()]);
  const shown = [...new Set(curves.filter(curve => parts(curve).layer === baseLayer()))].slice(0, 64);
  if (times && shown.length) link.send(`csv ${questions += 1} ${times[0]} ${times[1]} ${shown.join(',')}`);
}

/** Offers a table as a file. @param {any} what */
function written(what) {
  const names = what.curves.map((/** @type {number} */ curve) => {
    const { signal, case: at } = parts(curve), { label, unit } = hello.signals[signal];
    return `${[label, hello.cases[at]].filter(Boolean).join(', ')}${unit && ` [${unit}]`}`.replaceAll(',', ';');
  });
  const file = document.createElement('a');
  file.href = URL.createObjectURL(new Blob([`t [s],${names.join(',')}\n${what.rows}`], { type: 'text/csv' }));
  file.download = `${hello.title}.csv`;
  file.click();
  setTimeout(() => URL.revokeObjectURL(file.href), 10000);
}

/** A choice with a name. @param {string} name @param {[string, string][]} of @param {() => void} act */
function choice(name, of, act) {
  const made = document.createElement('select');
  made.setAttribute('aria-label', name);
  made.append(...of.map(([value, text]) => new Option(text, value)));
  made.onchange = act;
  return made;
}

function toggleTrigger() {
  const place = element('trigger');
  press(element('triggered'), !trigger);
  place.hidden = !!trigger;
  if (trigger) {
    trigger = null;
    return wake();
  }
  const shown = overTime().flatMap(one => one.canvas.signals);
  const level = document.createElement('input'), told = document.createElement('output');
  const rule = () => {
    const curve = baseLayer() * hello.cases.length * hello.signals.length + Number(signal.value);
    const value = Number(level.value.replace('−', '-'));
    const begin = hello.grows && state?.grows ? end : all()[0];
    trigger = { curve, way: way.value, level: Number.isFinite(value) ? value : 0, mode: mode.value, place: Number(part.value), after: begin, asked: -1, at: null, since: begin };
    told.textContent = words.waits;
    wake();
  };
  const signal = choice(words.signal, shown.map(one => [String(one), titled(one)]), rule), way = choice(words.way, words.ways, rule);
  const mode = choice(words.mode, words.modes, rule), part = choice(words.place, words.places, rule);
  mode.value = 'normal';
  level.type = 'text';
  level.value = '0';
  level.setAttribute('aria-label', words.level);
  level.onchange = rule;
  place.setAttribute('aria-label', words.triggerOf);
  place.replaceChildren(signal, way, level, mode, part, button(words.nextOne, () => {
    if (!trigger) return;
    trigger.after = trigger.at ?? trigger.after;
    trigger.at = null;
    trigger.asked = -1;
    wake();
  }), told);
  rule();
}

/** Looks for the next crossing of the trigger in all points. */
function seek() {
  if (!trigger || trigger.asked >= 0 || saved) return;
  const [from, to] = span();
  // The one that is shown stays until its window is over.
  if (trigger.at !== null && (trigger.mode === 'single' || !state?.grows || end < trigger.at + (to - from))) return;
  if (trigger.at === null && trigger.since >= end && trigger.after >= end) return;
  trigger.asked = questions += 1;
  link.send(`find ${trigger.asked} ${trigger.curve} ${trigger.way} ${trigger.level} ${trigger.after}`);
}

/** @param {number | null} t */
function found(t) {
  if (!trigger) return;
  const [from, to] = span(), width = to - from;
  if (t === null) {
    // Nothing yet: it is looked for again in what comes. `auto` goes on with the newest meanwhile.
    trigger.since = end;
    if (trigger.mode === 'auto' && state?.grows && end > (trigger.at ?? trigger.after) + width) now(width);
    const own = trigger;
    setTimeout(() => { own.asked = -1; wake(); }, 200);
    return;
  }
  trigger.at = trigger.after = t;
  trigger.asked = -1;
  const told = element('trigger').querySelector('output');
  if (told) told.textContent = words.foundAt(t);
  window_ = [t - trigger.place * width, t + (1 - trigger.place) * width];
  newest = null;
  asked = false;
  wake();
}

function mark() {
  const place = input('word'), text = place.value.trim();
  if (!text) return place.focus();
  command(`mark ${text}`, problem);
  place.value = '';
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

/** The first row of a table. @param {HTMLTableElement} table @param {string[]} names */
function heads(table, names) {
  const row = table.createTHead().insertRow();
  for (const name of names) {
    const cell = document.createElement('th');
    cell.scope = 'col';
    cell.textContent = name;
    row.append(cell);
  }
}

/** Values at 21 instants of the window. */
function table() {
  const [from, to] = span(), rows = [], times = overTime();
  const columns = times.flatMap(one => [...one.curves].filter(([curve]) => parts(curve).layer === baseLayer()).map(([curve, points]) => ({ curve, points })));
  const made = document.createElement('table');
  heads(made, [words.time, ...columns.map(({ curve }) => titled(curve))]);
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
  press(element('values'), !place.hidden);
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
  const alone = button(words.free, () => {
    free = !free;
    press(alone, free);
    plots.forEach(one => { one.plot.moved = null; });
    legend();
    wake();
  }, false);
  alone.id = 'free';
  alone.hidden = true;
  const triggered = button(words.trigger, toggleTrigger, false);
  triggered.id = 'triggered';
  element('word-name').textContent = words.word;
  element('mark').textContent = words.mark;
  element('mark').onclick = mark;
  input('word').onkeydown = event => { if (event.key === 'Enter') mark(); };
  tools.append(button(words.whole, () => move(null)), button(words.newest, home), button(words.closer, () => zoom(0.5)), button(words.wider, () => zoom(2)), values, measures, ...saved ? [] : [triggered], alone, shown);
  addEventListener('keydown', event => {
    const target = /** @type {HTMLElement} */ (event.target);
    if (event.key === 'Escape' && hello?.kind === 'rig') return stop();
    if (!hello || event.ctrlKey || event.metaKey || event.altKey || target.tagName === 'INPUT' && /** @type {HTMLInputElement} */ (target).type === 'text' || target.id === 'set') return;
    // A button takes its own space bar.
    if (event.key === ' ' && target.closest('button, input')) return;
    const [from, to] = span(), by = 0.2 * (to - from);
    const act = {
      '+': () => zoom(0.5), '=': () => zoom(0.5), '-': () => zoom(2), Home: home, ' ': hold, t: toggleTable, c: toggleCursors, u: () => knobs?.undo(), m: () => { if (hello.kind === 'rig') input('word').focus(); },
      ArrowLeft: () => (window_ || newest) && move([from - by, to - by]), ArrowRight: () => window_ && move([from + by, to + by]),
    }[event.key];
    if (act) {
      event.preventDefault();
      act();
    }
  });
  // Data that stand still must not look like a rig that stands still.
  if (!saved) setInterval(() => {
    const age = (performance.now() - endAt) / 1000, place = element('age');
    place.hidden = !(hello?.grows && state?.grows && end > 0 && age > 1);
    if (!place.hidden) place.textContent = words.old(age);
  }, 250);
  // A page that is silent does not operate.
  if (!saved) setInterval(() => { if (hello?.kind === 'rig') link.send('here'); }, 1000);
  new ResizeObserver(resize).observe(element('curves'));
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => { plots.forEach(names); element('legend').replaceChildren(); if (state) legend(); resize(); wake(); });
  addEventListener('beforeprint', () => { printing = true; resize(); draw(); });
  addEventListener('afterprint', () => { printing = false; });
}
start();
