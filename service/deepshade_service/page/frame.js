// The binary messages of a live session (docs/streaming.md), as far as a viewer gets them.

const HEAD = 40, VERSION = 1, ANSWER = 2;
const CODECS = {0: 'raw', 1: 'deflate', 16: 'jpeg', 17: 'webp'};
const MOST = 1 << 28;  // bytes of a plane, decoded
export const CUT = 1, REST = 2;

/** `{id, codec, flags, width, height, time, about, blocks}` of a message (an ArrayBuffer). */
export function readFrame(buffer) {
  const view = new DataView(buffer);
  if (buffer.byteLength < HEAD || view.getUint32(0) !== 0x44534c46 || view.getUint8(4) !== VERSION
    || view.getUint8(5) !== ANSWER) throw new Error('The service sent what is no answer.');
  const size = view.getUint32(20, true);
  const about = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, HEAD, size)));
  const blocks = [];
  for (let at = HEAD + size; at < buffer.byteLength;) {
    const length = view.getUint32(at, true);
    blocks.push(new Uint8Array(buffer, at + 4, length));
    at += 4 + length;
  }
  return {id: view.getUint32(8, true), codec: CODECS[view.getUint8(6)], flags: view.getUint8(7),
    width: view.getUint32(12, true), height: view.getUint32(16, true),
    time: view.getFloat64(24, true), about, blocks};
}

/** What a Picture is made of: a bitmap, or the planes of the effect that is `shown`. */
export async function decode(frame, shown) {
  const {codec, width, height, about, blocks} = frame;
  const [w, h] = about.full ?? [width, height];
  const place = {window: [0, 0, w, h], frame: [0, 0, w, h], size: [width, height], attributes: {}};
  if (codec === 'jpeg' || codec === 'webp') {
    const bitmap = await createImageBitmap(new Blob([blocks[0]], {type: `image/${codec}`}),
      {colorSpaceConversion: 'none', premultiplyAlpha: 'none'});
    return {...place, bitmap, half: false, names: ['R', 'G', 'B'], effect: about.shows};
  }
  const effect = about.effects.includes(shown) ? shown : about.effects[0];
  const mine = about.planes.map(([name, type], index) => ({name, type, index}))
    .filter(({name}) => name.startsWith(`${effect}.`));
  const half = mine.every(({type}) => type === 'half'), pixels = width * height;
  const planes = half ? new Uint16Array(mine.length * pixels) : new Float32Array(mine.length * pixels);
  const target = new Uint8Array(planes.buffer), each = planes.BYTES_PER_ELEMENT;
  await Promise.all(mine.map(async ({index}, at) => {
    const first = at * pixels * each;
    if (codec === 'raw') return target.set(blocks[index].subarray(0, pixels * each), first);
    const split = await inflate(blocks[index], pixels * each);
    for (let b = 0; b < each; b++)
      for (let p = 0; p < pixels; p++) target[first + p * each + b] = split[b * pixels + p];
  }));
  return {...place, half, planes, names: mine.map(({name}) => name.slice(effect.length + 1)), effect};
}

/** Exactly `size` bytes of zlib's format. */
async function inflate(bytes, size) {
  if (size > MOST) throw new Error('The frame is too large to be shown.');
  const found = new Uint8Array(size);
  const reader = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate')).getReader();
  let at = 0;
  for (let part; !(part = await reader.read()).done; at += part.value.length) {
    if (at + part.value.length > size) throw new Error('A plane of the frame is too long.');
    found.set(part.value, at);
  }
  if (at < size) throw new Error('A plane of the frame is too short.');
  return found;
}
