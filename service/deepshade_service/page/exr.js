// Reads what the service sends when it is asked for `compression=none`: one part, scanlines, 16- or
// 32-bit floats. Any other EXR is decoded by the service, which also checks strangers' files.
// Layout: "OpenEXR File Layout", openexr.com/en/latest/OpenEXRFileLayout.html.

import {fromHalf} from './half.js';

const MAGIC = 20000630, LONG_NAMES = 0x400, VERSION = 2;
const HALF = 1, FLOAT = 2;

class Cursor {
  constructor(buffer) {
    this.view = new DataView(buffer);
    this.at = 0;
  }
  u8() { return this.view.getUint8(this.at++); }
  i32() { return this.view.getInt32((this.at += 4) - 4, true); }
  text() {
    const start = this.at;
    while (this.u8());
    return this.decode(start, this.at - 1);
  }
  decode(from, to) {
    return new TextDecoder().decode(new Uint8Array(this.view.buffer, from, to - from));
  }
}

/** `{window, frame, names, half, planes, attributes}` of an EXR's bytes (an ArrayBuffer).
 *
 * `window` is where the pixels lie and `frame` the whole frame, as [x, y, width, height]; `planes`
 * holds the channels `names`, in the file's order, one after the other, as Uint16Array (the bits of
 * half floats, where all are) or Float32Array; `attributes` those that are text or one number.
 */
export function readExr(buffer) {
  const file = new Cursor(buffer);
  if (file.i32() !== MAGIC) throw new Error('The service sent no EXR.');
  if ((file.i32() & ~LONG_NAMES) !== VERSION) throw new Error('The EXR has tiles or parts.');
  const attributes = {};
  let channels = [], window, frame, compression;
  for (let name; (name = file.text());) {
    const kind = file.text(), size = file.i32(), end = file.at + size;
    if (kind === 'chlist') channels = readChannels(file);
    else if (kind === 'compression') compression = file.u8();
    else if (name === 'dataWindow') window = readBox(file);
    else if (name === 'displayWindow') frame = readBox(file);
    else if (kind === 'string') attributes[name] = file.decode(file.at, end);
    else if (kind === 'float') attributes[name] = file.view.getFloat32(file.at, true);
    else if (kind === 'int') attributes[name] = file.i32();
    file.at = end;
  }
  if (compression !== 0) throw new Error('The EXR is compressed.');
  const [, top, width, height] = window;
  const half = channels.every(channel => channel.type === HALF);
  const count = channels.length * width * height;
  const planes = half ? new Uint16Array(count) : new Float32Array(count);
  const target = new Uint8Array(planes.buffer), source = new Uint8Array(buffer);
  const table = file.at;
  for (let line = 0; line < height; line++) {
    file.at = file.view.getUint32(table + 8 * line, true);  // of 64 bits; no answer has 4 GiB
    const row = file.i32() - top;
    file.i32();  // its bytes
    channels.forEach((channel, index) => {
      const first = (index * height + row) * width;
      if (!half && channel.type === HALF) {
        for (let x = 0; x < width; x++)
          planes[first + x] = fromHalf(file.view.getUint16(file.at + 2 * x, true));
      } else {
        const each = half ? 2 : 4;
        target.set(source.subarray(file.at, file.at + each * width), each * first);
      }
      file.at += (channel.type === HALF ? 2 : 4) * width;
    });
  }
  return {window, frame, names: channels.map(channel => channel.name), half, planes, attributes};
}

function readChannels(file) {
  const channels = [];
  for (let name; (name = file.text());) {
    const type = file.i32();
    file.at += 12;  // linear, and a sampling of 1
    if (type !== HALF && type !== FLOAT) throw new Error(`Channel ${name} holds whole numbers.`);
    channels.push({name, type});
  }
  return channels;
}

function readBox(file) {
  const [x0, y0, x1, y1] = [file.i32(), file.i32(), file.i32(), file.i32()];
  return [x0, y0, x1 - x0 + 1, y1 - y0 + 1];
}
