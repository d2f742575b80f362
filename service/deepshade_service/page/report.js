// What is under way and what went wrong, where everybody sees it and screen readers say it.

import {$, el, plain} from './dom.js';
import {Problem} from './service.js';

/** Show that something is under way, in words, and how far it is (a share of 1) if that is known;
 *  without words, that nothing is. */
export function busy(text, part) {
  const bar = $('progress');
  bar.hidden = !text;
  if (!text) return;
  bar.setAttribute('aria-label', text);
  if (part === undefined) bar.removeAttribute('value');
  else bar.value = part;
}

/** For uploads. */
export const progress = part => busy('Sending …', part);

/** Say what went wrong and what to do. */
export function fail(error) {
  if (!(error instanceof Problem)) console.error(error);
  const fix = error.fix ? [el('p', {className: 'fix'}, plain(error.fix))] : [];
  $('problem').replaceChildren(el('p', {}, plain(error.message)), ...fix);
  $('problem').hidden = false;
}

export const failed = () => !$('problem').hidden;

export function clear() {
  $('problem').hidden = true;
}
