// What stands above the picture: what is compared, how, exposure, curve and zoom.

import {$, digits, el} from './dom.js';
import {CURVES} from './shader.js';
import {MODES} from './viewer.js';

const MODE_NAMES = {a: 'A', b: 'B', wipe: 'Wipe', difference: 'A − B'};
const EXPOSURES = 10;  // stops either way

/** The toolbar of a viewer: `choose(side, value)` is called for a choice, `auto()` for an exposure. */
export class Tools {
  constructor(root, viewer, {choose, auto}) {
    Object.assign(this, {viewer, auto, touched: false, single: true, wipe: $('wipe')});
    this.selects = {a: this.select('A', choose), b: this.select('B', choose)};
    this.modes = el('fieldset', {className: 'modes'}, el('legend', {}, 'View'), ...MODES.map(mode =>
      el('label', {}, el('input', {type: 'radio', name: 'mode', value: mode}),
        el('span', {}, MODE_NAMES[mode]))));
    this.modes.addEventListener('change', event => this.mode(event.target.value));
    this.exposure = el('input', {type: 'range', min: -EXPOSURES, max: EXPOSURES, step: .1, value: 0,
      'aria-label': 'Exposure in stops'});
    this.stops = el('output', {className: 'stops'});
    this.exposure.addEventListener('input', () => this.expose(Number(this.exposure.value), true));
    this.exposure.addEventListener('dblclick', () => this.expose(0, true));
    const automatic = el('button', {type: 'button', title: 'The brightest percent becomes white (E)'},
      'Auto');
    automatic.addEventListener('click', () => this.expose(auto(), true));
    this.curve = el('select', {'aria-label': 'Tone curve'},
      ...CURVES.map((name, value) => el('option', {value}, name)));
    this.curve.addEventListener('change', () => viewer.set({curve: Number(this.curve.value)}));
    const zoom = (text, label, act) => {
      const button = el('button', {type: 'button', title: label, 'aria-label': label}, text);
      button.addEventListener('click', act);
      return button;
    };
    this.level = el('output', {className: 'level'});
    root.append(
      el('div', {className: 'group sides'}, this.selects.a.label, this.modes, this.selects.b.label),
      el('div', {className: 'group'}, el('span', {className: 'word'}, 'EV'), this.exposure, this.stops,
        automatic, this.curve));
    $('zoom').append(
      zoom('−', 'Zoom out (−)', () => viewer.zoomTo(viewer.zoom / 2)), this.level,
      zoom('+', 'Zoom in (+)', () => viewer.zoomTo(viewer.zoom * 2)),
      zoom('1:1', 'A pixel a pixel (1)', () => viewer.zoomTo(1)), zoom('Fit', 'The whole frame (0)', () => viewer.fit()));
    viewer.addEventListener('view', () => { this.level.value = `${digits(100 * viewer.zoom, 3)} %`; });
    this.listen();
    this.expose(0);
    this.mode('a');
    this.alone(true);
  }

  select(name, choose) {
    const select = el('select', {'aria-label': `Picture ${name}`});
    select.addEventListener('change', () => choose(name.toLowerCase(), select.value));
    return {select, label: el('label', {className: 'side-select'}, el('b', {}, name), select)};
  }

  /** What can be chosen: groups of [value, text]. */
  offer(groups) {
    for (const {select} of Object.values(this.selects)) {
      const before = select.value;
      select.replaceChildren(...groups.filter(([, entries]) => entries.length).map(([label, entries]) =>
        el('optgroup', {label}, ...entries.map(([value, text]) => el('option', {value}, text)))));
      select.value = before;
    }
  }

  mode(mode) {
    this.modes.querySelector(`[value=${mode}]`).checked = true;
    document.body.dataset.mode = mode;
    this.viewer.set({mode});
    this.placeWipe();
    this.wipeTo(this.viewer.state.wipe);
  }

  /** With one picture alone there is nothing to wipe. */
  alone(alone) {
    this.single = alone;
    for (const input of this.modes.querySelectorAll('input:not([value=a])')) input.disabled = alone;
    this.placeWipe();
  }

  placeWipe() { this.wipe.hidden = this.single || this.viewer.state.mode !== 'wipe'; }

  /** Expose by so many stops; `touched`: somebody did, and no default changes it any more. */
  expose(stops, touched = false) {
    const exposure = Math.max(-EXPOSURES, Math.min(EXPOSURES, stops));
    this.touched ||= touched;
    this.exposure.value = exposure;
    this.stops.value = `${exposure < 0 ? '−' : '+'}${Math.abs(exposure).toFixed(1)}`;
    this.viewer.set({exposure});
  }

  wipeTo(part) {
    part = Math.max(0, Math.min(1, part));
    this.wipe.style.left = `${100 * part}%`;
    this.wipe.setAttribute('aria-valuenow', Math.round(100 * part));
    this.wipe.setAttribute('aria-valuetext', `${Math.round(100 * part)} % A`);
    this.viewer.set({wipe: part});
  }

  listen() {
    const {viewer, wipe} = this, {canvas} = viewer;
    wipe.addEventListener('pointerdown', event => wipe.setPointerCapture(event.pointerId));
    wipe.addEventListener('pointermove', event => {
      if (!wipe.hasPointerCapture(event.pointerId)) return;
      const box = canvas.getBoundingClientRect();
      this.wipeTo((event.clientX - box.left) / box.width);
    });
    wipe.addEventListener('keydown', event => {
      const by = {ArrowLeft: -.01, ArrowRight: .01, PageDown: -.1, PageUp: .1, Home: -1, End: 1}[event.key];
      if (!by) return;
      event.preventDefault();
      this.wipeTo(viewer.state.wipe + by);
    });
    canvas.addEventListener('keydown', event => this.arrow(event));
    document.addEventListener('keydown', event => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
      if (event.target.closest('input, select, textarea, dialog')) return;
      const act = this.keys[event.key.toLowerCase()];
      if (act) act[1](event.preventDefault());
    });
  }

  arrow(event) {
    const by = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}[event.key];
    const {viewer} = this, {frame} = viewer;
    if (!by || !frame) return;
    event.preventDefault();
    const from = viewer.cursor ?? [frame[0] + (frame[2] >> 1), frame[1] + (frame[3] >> 1)];
    const step = event.shiftKey ? 10 : 1;
    const inside = (p, i) => Math.max(frame[i], Math.min(frame[i] + frame[i + 2] - 1, p));
    viewer.point(from.map((p, i) => inside(p + by[i] * step, i)), true);
  }

  /** Keys: what each does, and how. */
  get keys() {
    const {viewer} = this, next = (step) => () => {
      const {select} = this.selects.b;
      const index = (select.selectedIndex + step + select.length) % select.length;
      select.selectedIndex = index;
      select.dispatchEvent(new Event('change'));
    };
    return {
      a: ['A alone', () => this.single || this.mode('a')],
      b: ['B alone', () => this.single || this.mode('b')],
      f: ['flip between A and B', () => this.single || this.mode(viewer.state.mode === 'a' ? 'b' : 'a')],
      w: ['wipe', () => this.single || this.mode('wipe')],
      d: ['difference', () => this.single || this.mode('difference')],
      ',': ['previous layer as B', next(-1)],
      '.': ['next layer as B', next(1)],
      '[': ['a third of a stop darker', () => this.expose(viewer.state.exposure - 1 / 3, true)],
      ']': ['a third of a stop brighter', () => this.expose(viewer.state.exposure + 1 / 3, true)],
      e: ['exposure by the picture', () => this.expose(this.auto(), true)],
      t: ['next tone curve', () => {
        this.curve.selectedIndex = (this.curve.selectedIndex + 1) % CURVES.length;
        viewer.set({curve: this.curve.selectedIndex});
      }],
      '+': ['zoom in', () => viewer.zoomTo(viewer.zoom * 2)],
      '=': ['', () => viewer.zoomTo(viewer.zoom * 2)],
      '-': ['zoom out', () => viewer.zoomTo(viewer.zoom / 2)],
      1: ['a pixel a pixel', () => viewer.zoomTo(1)],
      0: ['the whole frame', () => viewer.fit()],
      '?': ['this list', () => $('keys').showModal()],
    };
  }

  /** Rows for the list of keys. */
  listKeys() {
    const rows = Object.entries(this.keys).filter(([, [text]]) => text)
      .map(([key, [text]]) => [key.toUpperCase(), text]);
    rows.push(['Arrows', 'on the picture: to the next pixel, with Shift ten'], ['Wheel, pinch', 'zoom'],
      ['Drag', 'move'], ['Double click', 'near, and back']);
    return rows.flatMap(([key, text]) => [el('dt', {}, el('kbd', {}, key)), el('dd', {}, text)]);
  }
}
