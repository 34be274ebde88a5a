// The connection to the panel; or, in a saved report, the data in the page.
import { words } from './words.js';

/**
 * A curve as points; x in s or in the unit of its signal.
 * @typedef {{ view: number, curve: number, x: Float64Array, y: Float64Array }} Curve
 */

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
      curves.push({ view: id, curve, x, y });
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
