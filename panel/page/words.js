// All words of the page.

/** @param {number} x @param {number} digits */
export function number(x, digits) {
  if (!Number.isFinite(x)) return x > 0 ? '∞' : x < 0 ? '−∞' : '–';
  const size = Math.abs(x);
  const text = size !== 0 && (size < 1e-3 || size >= 1e6) ? x.toExponential(digits - 1) : String(Number(x.toPrecision(digits)));
  return text.replaceAll('-', '−');
}

/** A page of this panel by its number; one of another panel has a name. @param {number | string} page */
const named = page => typeof page === 'number' ? `page ${page}` : page;

export const words = {
  curves: 'Curves',
  parameters: 'Parameters',
  side: 'Parameters and results',
  undo: 'undo',
  asText: 'as the text',
  keep: (/** @type {string} */ letter) => `keep ${letter}`,
  go: (/** @type {string} */ letter) => `to ${letter}`,
  drawn: 'as the text',
  set: 'These values for `fric run`, `fric sweep`, `fric hil`',
  ghost: (/** @type {string} */ letter) => `curves of ${letter}`,
  steady: 'steady curve of the contact',
  slot: (/** @type {string} */ path, /** @type {string} */ kind) => `${path}: models that fit ${kind}`,
  goStaged: (/** @type {string} */ letter) => `prepare ${letter}`,
  none: 'nothing is changed',
  copy: 'copy',
  copied: 'copied',
  expected: 'Expected',
  stop: 'Stop  Esc',
  next: { enable: 'Enable', arm: 'Arm', again: 'Start again' },
  sure: { enable: 'Enable', arm: 'Press again to arm', again: 'Start again' },
  guest: 'you look on; Stop is yours too',
  youOperate: (/** @type {number} */ me) => `you operate (page ${me})`,
  operates: (/** @type {number | string} */ page) => `${named(page)} operates`,
  asksYou: (/** @type {number | string} */ page) => `${named(page)} asks to operate; without an answer it will, after 5 s`,
  asked: (/** @type {number | string} */ page) => `${named(page)} operates, and has 5 s to refuse`,
  refusedYou: (/** @type {number | string} */ page) => `${named(page)} operates, and has refused`,
  take: 'Take over',
  refuse: 'Refuse',
  give: 'Hand over',
  taken: (/** @type {any} */ answer) => `${answer.said}: taken by cycle ${answer.cycle}`,
  notConfirmed: 'Stop was sent, and the rig has not confirmed it: use the wired stop',
  apply: (/** @type {number} */ n) => n === 0 ? 'Apply' : n === 1 ? 'Apply 1 change ⏎' : `Apply ${n} changes ⏎`,
  discard: 'discard',
  now: (/** @type {string} */ text) => `now ${text}`,
  answered: (/** @type {any} */ answer) => `“${answer.said}” is refused: ${answer.refused}`,
  late: 'How late cycles began, µs',
  lateWords: (/** @type {any} */ late) => `p50 below ${number(late.p50, 2)} µs, p99 below ${number(late.p99, 2)} µs, at most ${number(late.max, 3)} µs, ${late.missed} missed`,
  drives: 'Drives and commands',
  of: (/** @type {any} */ command) => `${command.name} ${number(command.value, 3)} of ${number(command.low, 3)} to ${number(command.high, 3)} ${command.unit}`.trim(),
  energy: (/** @type {any} */ energy) => `energy given back: at most ${number(energy.share, 2)} of what its contact holds; ${energy.unpredicted ? `${energy.unpredicted} cycles without looking ahead` : 'commands look ahead where the rig says so'}`,
  twin: 'the model alone, from arming on',
  ahead: 'the model alone, anew each second',
  free: 'model from arming on',
  rms: (/** @type {number} */ rms) => ` (differs by ${number(rms, 2)} rms)`,
  events: 'What happened',
  nothing: 'nothing but cycles',
  table: 'Values',
  whole: 'all',
  newest: 'newest',
  closer: 'closer',
  wider: 'wider',
  values: 'values',
  cursors: 'cursors',
  csv: 'CSV between them',
  old: (/** @type {number} */ age) => `▲ data ${number(age, 2)} s old`,
  cursor: (/** @type {number} */ i) => `cursor ${i}`,
  between: (/** @type {number} */ from, /** @type {number} */ to) => `${number(from, 5)} s to ${number(to, 5)} s: Δt ${number(to - from, 5)} s, 1/Δt ${number(1 / (to - from), 4)} Hz`,
  measures: ['difference', 'min', 'max', 'mean', 'rms', 'peak to peak', 'period in s'],
  copyExpect: (/** @type {string} */ name) => `copy an expect of ${name}`,
  expect: (/** @type {string} */ name, /** @type {string} */ value, /** @type {number} */ from, /** @type {number} */ to) => `expect peak_to_peak(${name}) ~= ${value} +- 2 % after ${number(from, 6)} s before ${number(to, 6)} s`,
  mark: 'mark',
  word: 'Words for the log',
  trigger: 'trigger',
  triggerOf: 'Where the window stands',
  signal: 'signal of the trigger',
  way: 'way',
  ways: /** @type {[string, string][]} */ ([['rises', 'rises above'], ['falls', 'falls below']]),
  level: 'level',
  mode: 'how often',
  modes: /** @type {[string, string][]} */ ([['auto', 'auto'], ['normal', 'normal'], ['single', 'single']]),
  place: 'where in the window',
  places: /** @type {[string, string][]} */ ([['0.1', 'at 10 %'], ['0.5', 'in the middle'], ['0.9', 'at 90 %']]),
  nextOne: 'next',
  waits: 'waits',
  foundAt: (/** @type {number} */ t) => `at ${number(t, 7)} s`,
  keys: 'Keys: + and − zoom, ← and → move, Home shows all or the newest, the space bar holds, t shows values, c cursors, u undoes; on a rig m marks. The wheel zooms about the pointer, dragging moves.',
  experiments: 'Experiments',
  tools: 'Window of time',
  running: (/** @type {any} */ hello, /** @type {any} */ run) => {
    const judged = run.verdicts.filter((/** @type {any} */ v) => !v.shown), held = judged.filter((/** @type {any} */ v) => v.holds).length;
    const first = judged.length === 0 ? '' : held === judged.length ? 'as expected; ' : `${judged.length - held} of ${judged.length} not as expected; `;
    return `${first}${hello.solver}, ${run.words}`;
  },
  failed: (/** @type {string[]} */ failures) => failures.join('; '),
  lost: 'not connected: the panel has ended, or is being started again',
  wrongKey: 'this link is from an earlier start: open the one that is printed now',
  saved: 'a saved report',
  /** @param {any} state */
  rig: state => state.over ? state.over : state.stage === 'armed' ? 'armed, the model runs' : state.stage,
  recording: (/** @type {any} */ state) => `recording: ${state.words}`,
  refused: (/** @type {string} */ why) => why,
  summary: (/** @type {string} */ name, /** @type {string} */ unit, /** @type {number[]} */ [from, to, low, high, end]) =>
    low > high ? `${name}, ${number(from, 4)} s to ${number(to, 4)} s, no values`
      : `${name}, ${number(from, 4)} s to ${number(to, 4)} s, ${`${number(low, 4)} to ${number(high, 4)} ${unit}`.trim()}, at the end ${number(end, 4)}`,
  plane: (/** @type {string} */ y, /** @type {string} */ x) => `${y} over ${x}`,
  time: 't in s',
  slider: (/** @type {string} */ name) => `${name}, slider`,
  at: (/** @type {number} */ t) => `at ${number(t, 6)} s`,
};
