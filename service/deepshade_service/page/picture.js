// A picture to look at: planes of numbers, where they lie in the frame, and what they mean.

import {readExr} from './exr.js';
import {fromHalf} from './half.js';

export const FAR = 1e10;  // what the service takes for no surface
const SAMPLES = 1 << 16;  // pixels that statistics look at

/** How numbers are shown: radiance through exposure and a tone curve, factors as they are,
 *  directions as colours, other quantities from black to white over their range. */
export const KINDS = ['light', 'factor', 'direction', 'range'];

export class Picture {
  /** `exr` is what readExr gives; without a `kind` it is guessed from the values. `size` is the
   *  picture's own where it is a smaller one of its `window`; a `bitmap` may stand for planes. */
  constructor(exr, kind) {
    Object.assign(this, exr);
    this.count = exr.names.length;
    [this.x, this.y] = exr.window;
    [this.width, this.height] = exr.size ?? exr.window.slice(2);
    // EXR sorts channels by name, people say R G B
    this.order = exr.names.join() === 'B,G,R' ? [2, 1, 0]
      : exr.names.join() === 'A,B,G,R' ? [3, 2, 1, 0] : exr.names.map((_, index) => index);
    this.range = [0, 1];
    this.kind = kind;
    if (kind && kind !== 'range') return;
    this.range = this.findRange();
    const [low, high] = this.range;
    this.kind ??= low < 0 && low >= -1 && high <= 1 ? 'direction' : 'range';
  }

  static from(buffer, kind) { return new Picture(readExr(buffer), kind); }

  /** The values at a pixel of the frame, in order; null outside, and of 8 bits for eyes. */
  at(x, y) {
    const column = Math.floor((x - this.x) * this.width / this.window[2]);
    const row = Math.floor((y - this.y) * this.height / this.window[3]);
    if (this.bitmap) return null;
    if (column < 0 || row < 0 || column >= this.width || row >= this.height) return null;
    return this.order.map(channel => this.value(channel, row * this.width + column));
  }

  value(channel, pixel) {
    const stored = this.planes[channel * this.width * this.height + pixel];
    return this.half ? fromHalf(stored) : stored;
  }

  /** Finite values that show a surface, sorted, of evenly spaced pixels; `read` makes one of many. */
  sorted(read = pixel => this.value(0, pixel)) {
    const pixels = this.width * this.height, step = Math.max(1, Math.floor(pixels / SAMPLES)) | 1;
    const found = [];
    for (let pixel = 0; pixel < pixels; pixel += step) {
      const value = read(pixel);
      if (Number.isFinite(value) && Math.abs(value) < FAR) found.push(value);
    }
    return Float32Array.from(found).sort();
  }

  /** The exposure, in stops, at which the brightest percent becomes white. */
  autoExposure() {
    const values = this.sorted(pixel => Math.max(...this.order.slice(0, 3).map(c => this.value(c, pixel))));
    const high = share(values, .99);
    return high > 0 ? Math.max(-20, Math.min(20, -Math.log2(high))) : 0;
  }

  /** Between which values the picture's are, but for the outermost. */
  findRange() {
    const all = this.order.map(channel => this.sorted(pixel => this.value(channel, pixel)));
    const low = Math.min(...all.map(values => share(values, .01)));
    const high = Math.max(...all.map(values => share(values, .99)));
    if (!(low <= high)) return [0, 1];  // nothing finite
    return low < high ? [low, high] : [low - .5, low + .5];
  }
}

/** The value below which a share of the sorted values lie; NaN of none. */
export function share(sorted, part) {
  return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(part * sorted.length))] : NaN;
}

/** `{mean, bias, pixels}` of the difference of two pictures where both have finite values; channels
 *  are averaged, and one channel counts for all of the other's. null if there is no such pixel. */
export function compare(a, b) {
  if (a.bitmap || b.bitmap) return null;
  const x0 = Math.max(a.x, b.x), x1 = Math.min(a.x + a.window[2], b.x + b.window[2]);
  const y0 = Math.max(a.y, b.y), y1 = Math.min(a.y + a.window[3], b.y + b.window[3]);
  const channels = Math.min(3, Math.max(a.count, b.count));
  const step = Math.max(1, Math.floor((x1 - x0) * (y1 - y0) / SAMPLES)) | 1;
  let mean = 0, bias = 0, pixels = 0, turn = 0;
  for (let y = y0; y < y1; y++) {
    for (let x = x0; x < x1; x++) {
      if (turn++ % step) continue;
      const mine = a.at(x, y), other = b.at(x, y);
      let size = 0, sum = 0;
      for (let c = 0; c < channels; c++) {
        const error = (mine[c] ?? mine[0]) - (other[c] ?? other[0]);
        size += Math.abs(error);
        sum += error;
      }
      if (!Number.isFinite(sum)) continue;
      mean += size / channels;
      bias += sum / channels;
      pixels++;
    }
  }
  return pixels ? {mean: mean / pixels, bias: bias / pixels, pixels} : null;
}

/** How a layer's numbers are shown, from what the service says of it (see `GET /uploads/{name}`). */
export function kindOf(layer, effects) {
  const effect = effects.get(layer.reference);
  if (effect) return effect.light ? 'light' : 'factor';
  if (layer.unit?.startsWith('direction')) return 'direction';
  if (layer.unit === 'radiance' || layer.unit === 'reflectance') return 'light';
  if (layer.unit) return 'range';
  const names = layer.channels.map(name => name.slice(name.lastIndexOf('.') + 1).toUpperCase());
  if (names.length > 2) return names.includes('R') ? 'light' : undefined;
  return 'range';
}
