// An effect's settings as controls, from what GET /effects says: unit, range, default. A setting that
// isn't touched isn't sent, and shows what was used instead.

import {digits, el} from './dom.js';

const STEPS = 1000;  // of a slider

/** From a share of the slider to a value and back. */
const linear = (low, high) => [t => low + t * (high - low), v => (v - low) / (high - low)];
const even = (low, high) => [t => low * (high / low) ** t, v => Math.log(v / low) / Math.log(high / low)];

/** Whether a setting is how far something is away, as what is in focus. */
const isDistance = ({unit, lowest, learnt}) => unit === 'scene units' && lowest > 0 && !learnt;

export class Settings {
  /** Controls go into `root`; `changed` is called when one is, and `pick` lets the user point at a
   *  surface: it promises its distance, or null. */
  constructor(root, changed, pick) {
    Object.assign(this, {root, changed, pick, values: new Map(), shown: [], environments: []});
  }

  /** [name, value] of those that are set and that the effect has. */
  get query() {
    return this.shown.map(({name}) => [name, this.values.get(name)]).filter(([, value]) => value);
  }

  /** Show an effect's; `scene` has the picture's median depth and nearest and farthest. */
  show(effect, scene) {
    Object.assign(this, {effect, scene});
    this.shown = effect.settings.map(setting => ({name: setting.name, ...this.control(setting)}));
    this.root.replaceChildren(...this.shown.map(each => each.row));
  }

  /** The scene was measured meanwhile: sliders span it, and whatever is being typed stays. */
  rescale(scene) {
    this.scene = scene;
    for (const {follow} of this.shown) follow();
  }

  /** What the answer was made with, by its plan. */
  used(plan) {
    for (const {name, use} of this.shown) use(plan[name], plan[`${name}_source`]);
  }

  control(setting) {
    const id = `set-${setting.name}`;
    const label = el('label', {htmlFor: id}, setting.name[0].toUpperCase() + setting.name.slice(1));
    const choices = setting.unit === 'name' ? this.environments
      : setting.unit.includes(' or ') ? setting.unit.split(' or ') : null;
    const input = choices ? this.select(setting, choices) : this.number(setting);
    input.field.id = id;
    const reset = el('button', {type: 'button', className: 'reset', textContent: '×',
      title: 'Back to what the file says, or the default', 'aria-label': `Reset ${setting.name}`});
    const set = value => {
      if (value) this.values.set(setting.name, value);
      else this.values.delete(setting.name);
      reset.classList.toggle('off', !value);
      reset.disabled = !value;
      row.classList.toggle('set', !!value);
    };
    input.field.addEventListener('change', () => { set(input.field.value.trim()); input.follow(); this.changed(); });
    input.slider?.addEventListener('input', () => { set(input.field.value = input.read()); this.changed(); });
    reset.addEventListener('click', () => {
      input.field.value = '';
      set('');
      input.follow();
      this.changed();
      input.field.focus();
    });
    const unit = choices ? '' : isDistance(setting) ? this.picker(setting, value => {
      set(input.field.value = value);
      input.follow();
      this.changed();
    }) : el('span', {className: 'unit'}, setting.unit);
    const row = el('div', {className: 'setting', title: setting.meaning},
      label, input.slider ?? '', input.field, unit, reset, input.more ?? '');
    set(input.field.value = this.values.get(setting.name) ?? '');
    input.follow();
    return {row, use: input.use, follow: input.follow};
  }

  picker(setting, take) {
    const label = `Pick the ${setting.name} in the picture`;
    const button = el('button', {type: 'button', className: 'pick', title: label, 'aria-label': label}, '⌖');
    button.addEventListener('click', async () => {
      const distance = await this.pick();
      if (distance) take(String(Number(distance.toPrecision(4))));
    });
    return button;
  }

  select(setting, choices) {
    const usual = el('option', {value: '', textContent: `${setting.default ?? 'as it is'} (default)`});
    const field = el('select', {}, usual, ...choices.map(name => el('option', {value: name}, name)));
    const more = setting.unit === 'name' ? el('img', {className: 'thumbnail', alt: '', loading: 'lazy'}) : null;
    const follow = () => {
      const name = field.value || setting.default;
      if (more && name) more.src = `environments/${encodeURIComponent(name)}/thumbnail`;
    };
    const use = value => { if (value) usual.textContent = `${value} (used)`; };
    return {field, more, follow, use};
  }

  number(setting) {
    const slider = el('input', {type: 'range', min: 0, max: STEPS, 'aria-label': `${setting.name}, slider`});
    const field = el('input', {type: 'text', inputMode: 'decimal', autocomplete: 'off', spellcheck: false});
    const read = () => String(Number(this.scale(setting)[0](slider.value / STEPS).toPrecision(3)));
    let usual = Number.isFinite(setting.default) ? setting.default : NaN;
    const follow = () => {
      const text = field.value;
      const now = text.endsWith('%') ? parseFloat(text) / 100 * this.scene.median : text ? Number(text) : usual;
      const at = Math.round(STEPS * this.scale(setting)[1](now));
      slider.value = Number.isFinite(at) ? at : STEPS / 2;
      field.setAttribute('aria-invalid', text !== '' && !Number.isFinite(now));
      slider.setAttribute('aria-valuetext', Number.isFinite(now) ? `${digits(now, 3)} ${setting.unit}` : 'not set');
    };
    const use = (used, source) => {
      usual = Number(used);
      field.placeholder = Number.isFinite(usual) && used !== null ? digits(usual, 4) : 'not set';
      field.title = source ? `by ${source}` : '';
      if (!field.value) follow();
    };
    field.placeholder = Number.isFinite(usual) ? digits(usual) : '';
    return {field, slider, follow, use, read};
  }

  /** [share to value, value to share]: a length's slider spans what suits the scene, any other's what
   *  is allowed. */
  scale({unit, lowest, highest, learnt}) {
    const {median, near, far} = this.scene;
    if (unit === 'degrees') return linear(Math.max(lowest, -180), Math.min(highest, 180));
    if (unit !== 'scene units') return linear(lowest, highest);
    if (learnt) return even(learnt[0] * median / 2, learnt[1] * median * 2);
    return lowest === 0 ? linear(0, median / 10) : even(near, far);
  }
}
