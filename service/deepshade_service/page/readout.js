// Numbers about what is seen: values under the cursor, how far two pictures are apart, by whose fault.

import {digits, plain} from './dom.js';
import {compare} from './picture.js';

/** A line of the values of both pictures at a pixel [x, y], and their difference. */
export function valuesAt({a, b}, [x, y]) {
  const text = picture => {
    const found = picture?.at(x, y);
    return found ? found.map(value => digits(value, 4)).join(' ') : picture?.bitmap ? 'when it rests' : '–';
  };
  const line = `${x}, ${y}   A ${text(a)}${b ? `   B ${text(b)}` : ''}`;
  const [one, other] = [a?.at(x, y), b?.at(x, y)];
  if (!one || !other || a === b) return line;
  const channels = Math.min(3, Math.max(one.length, other.length));
  const apart = Array.from({length: channels}, (_, c) => (one[c] ?? one[0]) - (other[c] ?? other[0]));
  return `${line}   A − B ${apart.map(value => digits(value, 4)).join(' ')}`;
}

/** How far two pictures are apart; "" where that can't be said. */
export function apart({a, b}) {
  const found = a && b && a !== b ? compare(a, b) : null;
  return found ? `mean |A − B| ${digits(found.mean, 3)}, bias ${digits(found.bias, 3)}` : '';
}

/** Settings that a file's references were made with, where an answer's plan has others; "" if none. */
export function strays(settings, said, plan) {
  const differs = (one, other) => typeof one === 'number' && typeof other === 'number'
    ? Math.abs(one - other) > 1e-3 * Math.abs(other) : one !== other;
  const other = settings.map(({name}) => name)
    .filter(name => name in said && plan[name] !== undefined && differs(plan[name], said[name]));
  return other.map(name => `${name} ${typeof said[name] === 'number' ? digits(said[name]) : plain(said[name])}`)
    .join(', ');
}
