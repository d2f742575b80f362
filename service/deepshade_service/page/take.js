// What leaves the page: the answer as a file, the request as text.

import {$, el} from './dom.js';

const KEPT = 60000;  // ms until a file's bytes are let go: long enough for the browser to save them

/** Save a response's body as a file of that name. */
export async function save(response, name) {
  const url = URL.createObjectURL(await response.blob());
  el('a', {href: url, download: name.replace(/^\.\//, '')}).click();
  setTimeout(() => URL.revokeObjectURL(url), KEPT);
}

/** Show a text, and copy it where that is allowed. */
export async function copy(text, what) {
  $('snippet').textContent = text;
  $('snippet').hidden = false;
  try {
    await navigator.clipboard.writeText(text);
    $('copied').textContent = `Copied: ${what}.`;
  } catch {  // no permission, or no HTTPS
    getSelection().selectAllChildren($('snippet'));
    $('copied').textContent = 'Selected: copy it with your keys.';
  }
}
