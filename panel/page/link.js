// The connection to the panel; or, in a saved report, the data in the page.
import { words } from './words.js';

/**
 * A curve as points; x in s or in the unit of its signal. One in columns says which: `cycles` of each, the `first` one.
 * `store` holds the numbers of one that grows, from place `at` on, with room for more.
 * @typedef {{ view: number, curve: number, x: Float64Array, y: Float64Array, cycles?: number, first?: number, store?: { x: Float64Array, y: Float64Array, at: number } }} Curve
 */

/**
 * A curve with the newer columns of the same width in the place of its own from there on; those before `from` s are left
 * out. Where the columns do not touch, what lies between has left the window, and so have the older ones.
 * @param {Curve | undefined} old @param {Curve} fresh @param {number} from @returns {Curve}
 */
export function joined(old, fresh, from) {
  if (!old || !fresh.cycles || old.cycles !== fresh.cycles || fresh.first === undefined || old.first === undefined || fresh.first <= old.first
    || fresh.first > old.first + old.x.length / 2) return fresh;
  const end = Math.min(2 * (fresh.first - old.first), old.x.length);
  let begin = 0;
  while (begin + 2 < end && old.x[begin + 2] < from) begin += 2;
  const length = end - begin + fresh.x.length;
  let { store } = old, at = store ? store.at + begin : 0;
  if (!store || store.at + end + fresh.x.length > store.x.length) {
    store = { x: new Float64Array(2 * length + 64), y: new Float64Array(2 * length + 64), at: 0 };
    store.x.set(old.x.subarray(begin, end));
    store.y.set(old.y.subarray(begin, end));
    at = 0;
  }
  store.x.set(fresh.x, at + end - begin);
  store.y.set(fresh.y, at + end - begin);
  const [x, y] = [store.x, store.y].map(all => all.subarray(at, at + length));
  return { ...fresh, first: old.first + begin / 2, x, y, store: { ...store, at } };
}

/** Reads a frame. @param {ArrayBuffer} buffer @param {number} period @returns {{ number: number, newest: number, curves: Curve[] }} */
export function decode(buffer, period) {
  const view = new DataView(buffer);
  const curves = [];
  const blocks = view.getUint32(4, true);
  let at = 16;
  for (let block = 0; block < blocks; block++) {
    const kind = view.getUint16(at, true), id = view.getUint16(at + 2, true), curve = view.getUint32(at + 4, true);
    const cycles = view.getUint32(at + 8, true), count = view.getUint32(at + 12, true);
    const first = view.getFloat64(at + 16, true), base = view.getFloat64(at + 24, true);
    at += 32;
    const pairs = new Float32Array(buffer, at, 2 * count);
    at += 8 * count;
    if (kind === 1) {
      // Two extremes a column, in the order of time.
      const x = new Float64Array(2 * count), y = new Float64Array(2 * count);
      for (let i = 0; i < count; i++) {
        const begin = (first + i) * cycles;
        x[2 * i] = (cycles === 1 ? begin : begin + cycles / 4) * period;
        x[2 * i + 1] = (cycles === 1 ? begin : begin + 3 * cycles / 4) * period;
        y[2 * i] = base + pairs[2 * i];
        y[2 * i + 1] = base + pairs[2 * i + 1];
      }
      curves.push({ view: id, curve, x, y, cycles, first });
    } else {
      const x = new Float64Array(count), y = new Float64Array(count);
      for (let i = 0; i < count; i++) {
        x[i] = first + pairs[2 * i];
        y[i] = base + pairs[2 * i + 1];
      }
      curves.push({ view: id, curve, x, y });
    }
  }
  return { number: view.getUint32(0, true), newest: view.getFloat64(8, true), curves };
}

/** @param {(data: ArrayBuffer) => void} frame @param {(message: any) => void} message @param {(why: string) => void} lost */
export function connect(frame, message, lost) {
  let key = location.hash.slice(1);
  if (key) {
    sessionStorage.setItem('key', key);
    history.replaceState(null, '', location.pathname);
  } else {
    key = sessionStorage.getItem('key') ?? '';
  }
  let /** @type {WebSocket | null} */ socket = null, wait = 250, number = 0;
  const open = () => {
    const own = new WebSocket(`ws://${location.host}/socket`);
    own.binaryType = 'arraybuffer';
    own.onopen = () => { own.send(`key ${key}`); socket = own; };
    own.onmessage = event => {
      wait = 250;
      if (typeof event.data === 'string') message(JSON.parse(event.data)); else frame(event.data);
    };
    own.onclose = event => {
      socket = null;
      lost(event.reason === 'wrong key' ? words.wrongKey : words.lost);
      if (event.reason !== 'wrong key') setTimeout(open, wait);
      wait = Math.min(2 * wait, 4000);
    };
  };
  open();
  return {
    /** @param {string} line Nothing is kept for later: what cannot be sent now is not sent. */
    send: line => { if (socket?.readyState === WebSocket.OPEN) socket.send(line); },
    /** @param {string} line @returns {number} the number under which the answer comes */
    say: line => { number += 1; if (socket?.readyState === WebSocket.OPEN) socket.send(`${number} ${line}`); return number; },
    saved: null,
  };
}

/** @param {any} data @param {(message: any) => void} message */
export function embedded(data, message) {
  setTimeout(() => {
    message({ kind: 'hello', is: data.hello });
    message({ kind: 'state', is: data.state });
  });
  return { send: () => {}, say: () => 0, saved: data.curves };
}
