// The messages of the bus: msgpack maps of numbers, texts, lists. (@msgpack/msgpack does the same.)

export function pack(value) {
  if (value === null) return Buffer.from([0xc0]);
  if (typeof value === "boolean") return Buffer.from([value ? 0xc3 : 0xc2]);
  if (typeof value === "bigint") {
    const whole = Buffer.alloc(9, 0xcf);
    whole.writeBigUInt64BE(value, 1);
    return whole;
  }
  if (typeof value === "number") {
    const real = Buffer.alloc(9, 0xcb);
    real.writeDoubleBE(value, 1);
    return real;
  }
  if (typeof value === "string") {
    const letters = Buffer.from(value, "utf8");
    return Buffer.concat([sized(0xd9, letters.length), letters]);
  }
  const entries = Array.isArray(value) ? value : Object.entries(value).flat();
  return Buffer.concat([sized(Array.isArray(value) ? 0xdc : 0xde, value.length ?? entries.length / 2), ...entries.map(pack)]);
}

function sized(kind, count) {
  return kind === 0xd9 ? Buffer.from([0xda, count >> 8, count & 0xff]) : Buffer.from([kind, count >> 8, count & 0xff]);
}

// Whole numbers come as numbers where they are exact, else as BigInt.
export function unpack(bytes) {
  let at = 0;
  const take = (count) => bytes.subarray(at, (at += count));
  const whole = (count) => {
    const value = BigInt(`0x${take(count).toString("hex")}`);
    return value <= BigInt(Number.MAX_SAFE_INTEGER) ? Number(value) : value;
  };
  const many = (count, one) => Array.from({ length: count }, one);
  const map = (count) => Object.fromEntries(many(count, () => [read(), read()]));
  const letters = (count) => take(count).toString("utf8");
  function read() {
    if (at >= bytes.length) throw new Error("msgpack: a message ends too early");
    const kind = bytes[at++];
    if (kind < 0x80) return kind;
    if (kind < 0x90) return map(kind & 0x0f);
    if (kind < 0xa0) return many(kind & 0x0f, read);
    if (kind < 0xc0) return letters(kind & 0x1f);
    if (kind >= 0xe0) return kind - 0x100;
    switch (kind) {
      case 0xc0: return null;
      case 0xc2: return false;
      case 0xc3: return true;
      case 0xca: return take(4).readFloatBE();
      case 0xcb: return take(8).readDoubleBE();
      case 0xcc: return whole(1);
      case 0xcd: return whole(2);
      case 0xce: return whole(4);
      case 0xcf: return whole(8);
      case 0xd0: return take(1).readInt8();
      case 0xd1: return take(2).readInt16BE();
      case 0xd2: return take(4).readInt32BE();
      case 0xd3: return Number(take(8).readBigInt64BE());
      case 0xd9: return letters(whole(1));
      case 0xda: return letters(whole(2));
      case 0xdb: return letters(whole(4));
      case 0xdc: return many(whole(2), read);
      case 0xdd: return many(whole(4), read);
      case 0xde: return map(whole(2));
      case 0xdf: return map(whole(4));
      default: throw new Error(`msgpack: kind ${kind.toString(16)} is no part of a message`);
    }
  }
  return read();
}
