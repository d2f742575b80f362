// How an answer was made, in sentences.

import {digits, plain} from './dom.js';

const count = number => number.toLocaleString('en');
const listed = words => words.length < 2 ? words.join('')
  : `${words.slice(0, -1).join(', ')} and ${words.at(-1)}`;

/** Sentences from a plan (docs/service.md, "What an answer says"). */
export function planInWords(plan) {
  const {pixels} = plan;  // not of a stream, where they differ from frame to frame
  const sentences = [`The bundle “${plain(plan.bundle)}” on ${plan.engine} in ${plan.precision}:`
    + ` ${plain(plan.reason)}${plan.dssim == null ? '' : `; its published error is ${digits(plan.dssim, 3)} DSSIM`}.`];
  for (const [name, how] of Object.entries(plan.derived))
    sentences.push(`${name[0].toUpperCase()}${plain(name).slice(1)}: ${plain(how)}.`);
  const all = pixels?.width * pixels?.height;
  if (pixels) sentences.push(`${pixels.width} × ${pixels.height} pixels, of which ${pixels.background
    ? `${count(pixels.background)} (${digits(100 * pixels.background / all, 2)} %) show no surface`
    : 'all show a surface'}; computed ${pixels.tiles === 1 ? 'at once' : `in ${pixels.tiles} tiles`}.`);
  const {decoded, in_file: there} = plan.channels;
  sentences.push(`Read: ${listed(decoded.map(plain))} (${decoded.length} of ${there} channels).`);
  return sentences;
}

/** A sentence from a `Server-Timing` header and the milliseconds that the page waited. */
export function timingInWords(header, waited) {
  const stages = [...(header ?? '').matchAll(/([\w-]+);dur=([\d.]+)/g)]
    .map(([, name, ms]) => [name, Number(ms)]);
  const total = stages.reduce((sum, [, ms]) => sum + ms, 0);
  const each = stages.map(([name, ms]) => `${name} ${digits(ms, 2)}`);
  return `${digits(waited, 3)} ms from asking to seeing; ${digits(total, 3)} of them in the service`
    + (each.length ? ` (${each.join(', ')}).` : '.');
}
