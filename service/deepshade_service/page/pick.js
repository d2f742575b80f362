// Pointing at a surface, to take its distance.

import {$} from './dom.js';
import {FAR} from './picture.js';

/** How far what is clicked at is away, by the last channel of `picture`, or what Enter chooses at the
 *  viewer's cursor; null at Escape, and where there is no surface. */
export async function pick(viewer, picture) {
  const {canvas} = viewer, done = new AbortController(), {signal} = done;
  $('values').value = 'Click at a surface. With keys: arrows and Enter; Escape leaves it.';
  document.body.classList.add('picking');
  canvas.focus();
  const pixel = await new Promise(resolve => {
    canvas.addEventListener('click', () => resolve(viewer.cursor), {signal});
    addEventListener('keydown', ({key}) => {
      if (key === 'Enter') resolve(viewer.cursor);
      if (key === 'Escape') resolve(null);
    }, {signal});
  });
  done.abort();
  document.body.classList.remove('picking');
  const distance = pixel && Math.abs(picture.at(...pixel)?.at(-1));
  return distance > 0 && distance < FAR ? distance : null;
}
