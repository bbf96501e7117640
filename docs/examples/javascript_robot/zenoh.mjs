// As much of the Zenoh protocol (version 9, https://spec.zenoh.io) as a robot needs: a client over TCP that puts and
// subscribes. No package is needed. Where you have one (@eclipse-zenoh/zenoh-ts, which asks the router for its plugin
// remote-api), take it instead: the keys and messages are the same.

import { randomBytes } from "node:crypto";
import net from "node:net";

const VERSION = 9, CLIENT = 2, LEASE_MILLISECONDS = 10_000, BATCH = 65_535;
const INIT = 0x01, OPEN = 0x02, CLOSE = 0x03, KEEP_ALIVE = 0x04, FRAME = 0x05;
const PUSH = 0x1d, DECLARE = 0x1e, DECLARE_KEY = 0x00, DECLARE_SUBSCRIBER = 0x02, PUT = 0x01;
const ACK = 0x20, SIZES = 0x40, RELIABLE = 0x20, SUFFIX = 0x20, STAMPED = 0x20, ENCODED = 0x40, EXTENDED = 0x80;
const SN_MASK = 2 ** 28 - 1; // sequence numbers of 32 bits carry 28

function number(value) {
  const bytes = [];
  let left = BigInt(value);
  for (; left > 0x7fn; left >>= 7n) bytes.push(Number(left & 0x7fn) | 0x80);
  bytes.push(Number(left));
  return Buffer.from(bytes);
}

const slice = (bytes) => Buffer.concat([number(bytes.length), bytes]);
const text = (value) => slice(Buffer.from(value, "utf8"));

class Reader {
  constructor(bytes) {
    this.bytes = bytes;
    this.at = 0;
  }
  get left() {
    return this.bytes.length - this.at;
  }
  byte() {
    if (this.left < 1) throw new Error("zenoh: a message ends too early");
    return this.bytes[this.at++];
  }
  number() {
    let value = 0n;
    for (let shift = 0n; shift < 64n; shift += 7n) {
      const byte = this.byte();
      value |= BigInt(byte & 0x7f) << shift;
      if (byte < 0x80) return Number(value);
    }
    throw new Error("zenoh: a number is too long");
  }
  slice() {
    const length = this.number();
    if (length > this.left) throw new Error("zenoh: a message ends too early");
    this.at += length;
    return this.bytes.subarray(this.at - length, this.at);
  }
  extensions(header) {
    for (let more = header & EXTENDED; more; ) {
      const kind = this.byte();
      more = kind & EXTENDED;
      if ((kind & 0x60) === 0x20) this.number();
      else if ((kind & 0x60) === 0x40) this.slice();
    }
  }
}

export class Session {
  // Joins the router or peer at host:port; resolves once it is in. `onClose` is called when the link ends.
  static async open(host, port, onClose = () => {}) {
    const session = new Session();
    await session.#join(host, port, onClose);
    return session;
  }

  #socket;
  #waiting = Buffer.alloc(0);
  #sent = 0;
  #keys = new Map(); // of the far end, by number
  #heard = new Map(); // by key
  #answer = () => {};

  async #join(host, port, onClose) {
    this.#socket = net.connect({ host, port, noDelay: true });
    const ended = new Promise((_, reject) => {
      this.#socket.on("error", reject);
      this.#socket.on("close", () => reject(new Error("zenoh: the link ended")));
    });
    this.#socket.on("data", (data) => this.#receive(data));
    await Promise.race([new Promise((done) => this.#socket.once("connect", done)), ended]);
    const id = randomBytes(16);
    id[15] |= 1; // no leading zero
    const sizes = Buffer.from([0x0a, BATCH & 0xff, BATCH >> 8]);
    const hello = Buffer.concat([Buffer.from([INIT | SIZES, VERSION, (15 << 4) | CLIENT]), id, sizes]);
    const [first, accepted] = await Promise.race([this.#ask(hello), ended]);
    if ((first & 0x1f) !== INIT) throw new Error("zenoh: was not let in");
    accepted.byte(); // version
    const size = (accepted.byte() >> 4) + 1;
    accepted.at += size; // who it is
    if (first & SIZES) accepted.at += 3;
    const open = Buffer.concat([Buffer.from([OPEN]), number(LEASE_MILLISECONDS), number(0), slice(accepted.slice())]);
    const [second] = await Promise.race([this.#ask(open), ended]);
    if ((second & (0x1f | ACK)) !== (OPEN | ACK)) throw new Error("zenoh: was not let in");
    ended.catch(() => {});
    this.#socket.removeAllListeners("error").removeAllListeners("close");
    this.#socket.on("error", () => {}).on("close", () => {
      clearInterval(this.beat);
      onClose();
    });
    this.beat = setInterval(() => this.#write(Buffer.from([KEEP_ALIVE])), LEASE_MILLISECONDS / 4);
  }

  #ask(message) {
    this.#write(message);
    return new Promise((done) => (this.#answer = (header, reader) => done([header, reader])));
  }

  #write(batch) {
    const length = Buffer.alloc(2);
    length.writeUInt16LE(batch.length);
    this.#socket.write(Buffer.concat([length, batch]));
  }

  #send(message) {
    const header = Buffer.concat([Buffer.from([FRAME | RELIABLE]), number(this.#sent)]);
    this.#sent = (this.#sent + 1) & SN_MASK;
    this.#write(Buffer.concat([header, message]));
  }

  put(key, payload) {
    const head = Buffer.concat([Buffer.from([PUSH | SUFFIX]), number(0), text(key)]);
    this.#send(Buffer.concat([head, Buffer.from([PUT]), slice(payload)]));
  }

  subscribe(key, heard) {
    this.#heard.set(key, heard);
    const body = [Buffer.from([DECLARE_SUBSCRIBER | SUFFIX]), number(this.#heard.size), number(0), text(key)];
    this.#send(Buffer.concat([Buffer.from([DECLARE]), ...body]));
  }

  close() {
    clearInterval(this.beat);
    this.#socket.removeAllListeners("close");
    this.#write(Buffer.from([CLOSE | 0x20, 0]));
    this.#socket.end();
  }

  #receive(data) {
    this.#waiting = Buffer.concat([this.#waiting, data]);
    while (this.#waiting.length >= 2) {
      const length = this.#waiting.readUInt16LE(0);
      if (this.#waiting.length < 2 + length) return;
      const batch = new Reader(this.#waiting.subarray(2, 2 + length));
      this.#waiting = this.#waiting.subarray(2 + length);
      while (batch.left > 0 && this.#transport(batch));
    }
  }

  #transport(batch) {
    const header = batch.byte(), kind = header & 0x1f;
    if (kind === KEEP_ALIVE) return true;
    if (kind === FRAME) {
      batch.number();
      batch.extensions(header);
      while (batch.left > 0 && this.#network(batch));
      return false;
    }
    if (kind === CLOSE) this.#socket.end();
    this.#answer(header, batch);
    return false;
  }

  // False where the rest of the batch is nothing for a robot: who asks what there is.
  #network(batch) {
    const header = batch.byte(), kind = header & 0x1f;
    if (kind === PUSH) return this.#push(header, batch);
    if (kind !== DECLARE) return false;
    if (header & 0x20) batch.number();
    batch.extensions(header);
    const inner = batch.byte();
    if ((inner & 0x1f) !== DECLARE_KEY) return false;
    const own = batch.number();
    this.#keys.set(own, this.#key(inner, batch));
    batch.extensions(inner);
    return true;
  }

  #key(header, batch) {
    const start = batch.number();
    return (start ? (this.#keys.get(start) ?? "") : "") + (header & SUFFIX ? batch.slice().toString("utf8") : "");
  }

  #push(header, batch) {
    const key = this.#key(header, batch);
    batch.extensions(header);
    const body = batch.byte();
    if ((body & 0x1f) !== PUT) return false;
    if (body & STAMPED) {
      batch.number();
      batch.slice();
    }
    if (body & ENCODED && batch.number() & 1) batch.slice();
    batch.extensions(body);
    const payload = batch.slice();
    this.#heard.get(key)?.(payload);
    return true;
  }
}
