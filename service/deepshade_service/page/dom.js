// Small helpers over the document. Text is only ever set as text: nothing here parses HTML.

/** The element with this id. */
export const $ = id => document.getElementById(id);

/** A new element: properties, then children (nodes or text). `data-`, `aria-`, `role` and such are
 *  attributes. */
export function el(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name in element && !name.includes('-')) element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}

/** Says it to the eye in `element`, and to screen readers, which watch it as a live region. */
export function say(element, text, kind = '') {
  element.textContent = text;
  element.className = kind;
  element.hidden = !text;
}

/** A number with so many significant digits, as people write it. */
export function digits(value, count = 4) {
  if (!Number.isFinite(value)) return Number.isNaN(value) ? 'NaN' : value > 0 ? '∞' : '−∞';
  if (value === 0) return '0';
  const size = Math.abs(value);
  const text = size < 1e-4 || size >= 1e6 ? value.toExponential(count - 1)
    : String(Number(value.toPrecision(count)));
  return text.replace('-', '−');
}

/** Bytes in the unit that suits them. */
export function bytes(count) {
  const units = ['bytes', 'kB', 'MB', 'GB'];
  const step = Math.min(3, count < 1000 ? 0 : Math.floor(Math.log10(count) / 3));
  return `${step ? (count / 1000 ** step).toPrecision(3) : count} ${units[step]}`;
}

/** Text for an attribute or a status line: control and direction-changing characters are shown. */
export function plain(text) {
  return String(text).replace(/[\u0000-\u001f\u007f-\u009f\u200e\u200f\u202a-\u202e\u2066-\u2069]/g,
    '\ufffd');
}
