// The page that shades: a picture comes in, settings change, the answer is looked at and taken along.

import {$, bytes, digits, el, plain, say} from './dom.js';
import {FAR, Picture, compare, kindOf, share} from './picture.js';
import {ask, json, Problem, Source} from './service.js';
import {Settings} from './settings.js';
import {curl, named, python} from './snippets.js';
import * as theme from './theme.js';
import {Tools} from './tools.js';
import {Viewer} from './viewer.js';
import {planInWords, timingInWords} from './words.js';

const ANSWER = 'answer', FIRST_SAMPLE = 'room';
const SCENE = {median: 1, near: .1, far: 10};  // until the picture is measured
const effects = new Map();
let source = null, effect = null, answer = null;
let layers = new Map();  // index -> promise of a Picture
let chosen = {a: ANSWER, b: null}, chosenByHand = false, modeByHand = false;
let shading = false, again = false, opening = null;
let fresh = false;  // whether the answer to come is the first of its picture and effect

const settings = new Settings($('settings'), () => shade(), pickDistance);
const {viewer, tools} = makeViewer();

function makeViewer() {
  try {
    const viewer = new Viewer($('canvas'));
    const tools = new Tools($('tools'), viewer, {choose, auto: () => (viewer.pictures.a ?? viewer.pictures.b)?.autoExposure() ?? 0});
    return {viewer, tools};
  } catch (error) {
    say($('nothing'), error.message);
    return {};
  }
}

/* Pictures */

/** Open files or a sample: its layers are looked at while it is shaded. `quiet`: if it is there. */
async function open(files, sample, quiet = false) {
  const opened = new Source(files, sample);
  clearProblem();
  busy('Sending …', 0);
  try {
    await opened.open(progress);
  } catch (error) {
    if (!(quiet && error.status === 404)) fail(error);
    return;
  } finally {
    busy();
  }
  if (quiet && source) return;  // somebody was quicker
  source = opened;
  layers = new Map();
  chosenByHand = false;
  chosen = {a: ANSWER, b: null};
  $('sample').value = sample ?? '';
  viewer?.show('b', null);
  noAnswer();
  describe();
  await settle();
}

function describe() {
  const {held} = source, [x0, y0, x1, y1] = held.display_window;
  const size = held.files.reduce((sum, file) => sum + file.bytes, 0);
  $('title').textContent = plain(source.title);
  document.title = `${plain(source.title)} · deepshade`;
  say($('holds'), `${x1 - x0 + 1} × ${y1 - y0 + 1}, ${held.layers.length} layers, ${bytes(size)}`
    + `${held.profile ? `, from ${held.profile}` : ''}.`, 'note');
}

/** Another picture or effect: choose what is compared, then shade. */
async function settle() {
  if (!source || !effect) return;
  const from = source;
  if (!chosenByHand) chosen.b = usual();
  offer();
  const beauty = from.held.layers.some(each => each.attribute === 'beauty' || String(each.channels) === 'R,G,B');
  $('multiplied').hidden = effect.light || !beauty;
  settings.show(effect, from.scene ?? SCENE);
  fresh = true;
  // the reference first, for it is there at once; lengths wait until something is seen
  await showSide('b');
  const shaded = shade();
  from.scene ??= await measure();
  if (source === from) settings.rescale(from.scene);
  await shaded;
}

/** What the answer is compared with at first: its reference, else the picture, else normals. */
function usual() {
  const {layers: all} = source.held;
  const find = test => all.findIndex(test);
  const index = [
    find(layer => layer.reference === effect.name), find(layer => layer.attribute === 'beauty'),
    find(layer => layer.unit === 'radiance'), find(layer => layer.unit?.startsWith('direction')), 0,
  ].find(at => at >= 0);
  return all.length ? String(index) : null;
}

const hasReference = () => source.held.layers[chosen.b]?.reference === effect.name;

function offer() {
  const {layers: all} = source.held, several = source.held.files.length > 1;
  const entries = all.map((layer, index) => [String(index), plain(several ? `${layer.name} (${source.held.files[layer.file].name})` : layer.name)]);
  tools?.offer([
    ['Made here', [[ANSWER, effect.title]]],
    ['References', entries.filter((_, index) => all[index].reference)],
    ['In the file', entries.filter((_, index) => !all[index].reference)],
  ]);
  if (!tools) return;
  for (const side of ['a', 'b']) tools.selects[side].select.value = chosen[side] ?? '';
  if (!modeByHand) tools.mode(hasReference() ? 'wipe' : 'a');
}

/** The layer whose last channel says how far surfaces are away; undefined if there is none. */
function distances() {
  const {layers: all} = source.held;
  return ['depth', 'distance', 'position'].map(name => all.findIndex(layer => layer.attribute === name)).find(at => at >= 0);
}

/** The median depth of the picture, and the nearest and farthest: what lengths are measured by. */
async function measure() {
  const index = distances();
  if (index === undefined) return SCENE;
  try {
    const picture = await layer(index);
    const depths = picture.sorted(pixel => Math.abs(picture.value(picture.order.at(-1), pixel))).filter(value => value > 0);
    const [near, median, far] = [.02, .5, .98].map(part => share(depths, part));
    return near > 0 && far > near ? {near, median, far} : SCENE;
  } catch {
    return SCENE;  // what is wrong with it is said when it is shaded
  }
}

/** How far what is clicked at is away, or what Enter chooses at the cursor; null at Escape. */
async function pickDistance() {
  const index = source && distances(), canvas = $('canvas');
  if (!viewer || index === undefined) return null;
  const picture = await layer(index);
  $('values').value = 'Click at a surface. With keys: arrows and Enter; Escape leaves it.';
  document.body.classList.add('picking');
  canvas.focus();
  const done = new AbortController(), {signal} = done;
  const chosen = await new Promise(resolve => {
    canvas.addEventListener('click', () => resolve(viewer.cursor), {signal});
    addEventListener('keydown', ({key}) => {
      if (key === 'Enter') resolve(viewer.cursor);
      if (key === 'Escape') resolve(null);
    }, {signal});
  });
  done.abort();
  document.body.classList.remove('picking');
  const found = chosen && Math.abs(picture.at(...chosen)?.at(-1));
  return found > 0 && found < FAR ? found : null;
}

function layer(index) {
  if (!layers.has(index)) {
    const from = source, about = source.held.layers[index];
    const got = from.use(async name => {
      const response = await ask(`uploads/${name}/layers/${index}`);
      return Picture.from(await response.arrayBuffer(), kindOf(about, effects));
    }, progress);
    layers.set(index, got);
    got.catch(() => layers.delete(index));
  }
  return layers.get(index);
}

function choose(side, value) {
  chosen[side] = value;
  chosenByHand = true;
  showSide(side);
}

async function showSide(side) {
  const value = chosen[side], from = source;
  let picture = answer;
  if (value === null) return;
  if (value !== ANSWER) {
    try {
      picture = await layer(Number(value));
    } catch (error) {
      return fail(error);
    }
  }
  if (chosen[side] !== value || source !== from || !viewer) return;  // chosen anew meanwhile
  viewer.show(side, picture);
  if (fresh && value !== ANSWER && hasReference()) exposeFor(picture);
  label();
}

/** An exposure that suits the first picture of an effect, unless somebody has chosen one. */
function exposeFor(picture) {
  if (tools && !tools.touched) tools.expose(effect.light ? picture.autoExposure() : 0);
}

function label() {
  for (const side of ['a', 'b']) {
    const {select} = tools.selects[side];
    $(`name${side.toUpperCase()}`).textContent = viewer.pictures[side] ? select.selectedOptions[0]?.textContent ?? ''
      : shading ? 'shading …' : '';
  }
  tools.alone(!viewer.pictures.a || !viewer.pictures.b);
  const {a, b} = viewer.pictures, apart = a && b && a !== b ? compare(a, b) : null;
  $('apart').textContent = apart ? `mean |A − B| ${digits(apart.mean, 3)}, bias ${digits(apart.bias, 3)}${strays()}` : '';
  $('canvas').setAttribute('aria-label', `A: ${$('nameA').textContent}. B: ${$('nameB').textContent}. Arrow keys move a cursor from pixel to pixel.`);
  values();
}

/** What the file's references were made with, where the answer was made with something else. */
function strays() {
  if (!answer || !Object.values(chosen).some(value => source.held.layers[value]?.reference)) return '';
  const said = source.held.settings, used = answer.plan;
  const other = effect.settings.map(({name}) => name).filter(name => name in said && used[name] !== undefined
    && (typeof used[name] === 'number' ? Math.abs(used[name] - said[name]) > 1e-3 * Math.abs(said[name]) : used[name] !== said[name]));
  const values = other.map(name => `${name} ${typeof said[name] === 'number' ? digits(said[name]) : plain(said[name])}`);
  return other.length ? `; the reference has ${values.join(', ')}` : '';
}

function values() {
  const {cursor} = viewer;
  if (!cursor) return;
  const [x, y] = cursor, read = side => viewer.pictures[side]?.at(x, y);
  const [a, b] = [read('a'), read('b')];
  const text = found => found ? found.map(value => digits(value, 4)).join(' ') : '–';
  let line = `${x}, ${y}   A ${text(a)}   B ${text(b)}`;
  if (a && b && viewer.pictures.a !== viewer.pictures.b) {
    const apart = Array.from({length: Math.min(3, Math.max(a.length, b.length))}, (_, c) => (a[c] ?? a[0]) - (b[c] ?? b[0]));
    line += `   A − B ${text(apart)}`;
  }
  $('values').value = line;
}

/* Shading */

/** What is asked for, as [name, value] pairs. */
function query() {
  const bundle = $('bundle').value ? [['bundle', $('bundle').value]] : [];
  return [...settings.query, ...bundle, ...new URLSearchParams($('more').value)];
}

/** And what of the answer is taken along. */
function queryToTake() {
  const on = (id, name, value) => $(id).checked && !$(id).closest('[hidden]') ? [[name, value]] : [];
  return [...query(), ...on('append', 'append', '1'), ...on('multiply', 'multiply', '1'), ...on('float', 'half', 'false')];
}

const shadePath = (name, pairs) => `shade/${effect.name}?${new URLSearchParams([['upload', decodeURIComponent(name)], ...pairs])}`;

/** Shade with the settings as they are now: one request at a time, and the latest wins. */
async function shade() {
  if (!source || !effect) return;
  const {lacks} = source.held.effects[effect.name];
  say($('lacks'), lacks ? `Not from this picture: ${plain(lacks)}.` : '', 'note lacks');
  if (lacks && !$('more').value) return noAnswer();
  if (shading) {
    again = true;
    return;
  }
  shading = true;
  const timer = setTimeout(() => busy('Shading …'), 150);
  if (viewer && !answer) label();
  try {
    do {
      again = false;
      await shadeOnce();
    } while (again);
  } catch (error) {
    fail(error);
  } finally {
    clearTimeout(timer);
    shading = false;
    busy();
    if (viewer) label();
  }
  if (again) shade();
}

async function shadeOnce() {
  const asked = {source, effect}, start = performance.now();
  const response = await source.use(name => ask(shadePath(name, [...query(), ['compression', 'none']]), {method: 'POST'}), progress);
  const body = await response.arrayBuffer();
  if (asked.source !== source || asked.effect !== effect) {
    again = true;
    return;
  }
  const picture = Picture.from(body, effect.light ? 'light' : 'factor');
  answer = picture;
  picture.plan = JSON.parse(picture.attributes['deepshade:plan']);
  clearProblem();
  if (fresh) exposeFor(picture);
  fresh = false;
  for (const side of ['a', 'b']) if (chosen[side] === ANSWER) viewer?.show(side, picture);
  if (viewer) label();
  settings.used(picture.plan);
  tell(picture.plan);
  $('timing').textContent = timingInWords(response.headers.get('server-timing'), performance.now() - start);
  for (const id of ['download', 'curl', 'python']) $(id).disabled = false;
}

function noAnswer() {
  answer = null;
  for (const side of ['a', 'b']) if (chosen[side] === ANSWER) viewer?.show(side, null);
  for (const id of ['download', 'curl', 'python']) $(id).disabled = true;
  for (const id of ['plan', 'warnings', 'timing']) $(id).replaceChildren();
  $('warnings').hidden = true;
  if (viewer) label();
}

function tell(plan) {
  $('plan').replaceChildren(...planInWords(plan).map(sentence => el('li', {}, sentence)));
  $('warnings').replaceChildren(...plan.warnings.map(warning => el('li', {}, plain(warning))));
  $('warnings').hidden = !plan.warnings.length;
}

async function download() {
  $('download').disabled = true;
  try {
    const asked = queryToTake();
    const response = await source.use(name => ask(shadePath(name, asked), {method: 'POST'}), progress);
    const url = URL.createObjectURL(await response.blob());
    el('a', {href: url, download: named(source, effect.name).replace(/^\.\//, '')}).click();
    setTimeout(() => URL.revokeObjectURL(url), 60000);
  } catch (error) {
    fail(error);
  }
  $('download').disabled = false;
}

async function copy(text, what) {
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

/* What is said */

function busy(text, part) {
  $('progress').hidden = !text;
  if (!text) return;
  $('progress').setAttribute('aria-label', text);
  if (part === undefined) $('progress').removeAttribute('value');
  else $('progress').value = part;
}

const progress = part => busy('Sending …', part);

function fail(error) {
  if (!(error instanceof Problem)) console.error(error);
  $('problem').replaceChildren(el('p', {}, plain(error.message)), ...(error.fix ? [el('p', {className: 'fix'}, plain(error.fix))] : []));
  $('problem').hidden = false;
  if (error.kind === 'unreachable') setTimeout(() => shading || $('problem').hidden || (source ? shade() : begin()), 2000);
}

function clearProblem() {
  $('problem').hidden = true;
}

/* The beginning */

function chooseEffect(name) {
  effect = effects.get(name);
  $('effect').value = name;
  $('bundle').replaceChildren(el('option', {value: ''}, 'usual bundle'), ...effect.bundles.map(({name, dssim}) =>
    el('option', {value: name}, `${name}${dssim == null ? '' : `, DSSIM ${digits(dssim, 3)}`}`)));
}

async function begin() {
  const wanted = new URLSearchParams(location.hash.slice(1));
  opening ??= open(null, wanted.get('sample') ?? FIRST_SAMPLE, !wanted.get('sample'));
  try {
    const [samples, found, maps] = await Promise.all([json('samples'), json('effects'), json('environments')]);
    settings.environments = maps.map(map => map.name);
    $('sample').replaceChildren(el('option', {value: ''}, '–'), ...samples.map(name => el('option', {value: name}, name)));
    $('sample').value = source?.sample ?? '';
    for (const each of found.filter(each => each.bundles.length)) effects.set(each.name, each);
    if (!effects.size) {
      say($('lacks'), 'The service is still loading …', 'note');
      return void setTimeout(begin, 500);
    }
    $('effect').replaceChildren(...[...effects.values()].map(each => el('option', {value: each.name}, each.title)));
    const most = [...effects.values()].reduce((best, each) => each.bundles.length > best.bundles.length ? each : best);
    chooseEffect(effects.has(wanted.get('effect')) ? wanted.get('effect') : most.name);
    await settle();
  } catch (error) {
    fail(error);
  }
}

/** #sample=…&effect=… of the address, so that a link leads to what it shows. */
function remember() {
  if (effect) history.replaceState(null, '', `#${new URLSearchParams({...(source?.sample ? {sample: source.sample} : {}), effect: effect.name})}`);
}

$('open').addEventListener('click', () => $('files').click());
$('files').addEventListener('change', () => {
  if ($('files').files.length) open([...$('files').files]);
  $('files').value = '';  // so that the same file can be opened again
});
$('sample').addEventListener('change', () => $('sample').value && open(null, $('sample').value));
$('effect').addEventListener('change', () => {
  chooseEffect($('effect').value);
  settle().finally(remember);
});
for (const id of ['bundle', 'more']) $(id).addEventListener('change', () => shade());
$('download').addEventListener('click', download);
$('curl').addEventListener('click', () => copy(curl(source, effect.name, queryToTake()), 'a line for a shell'));
$('python').addEventListener('click', () => copy(python(source, effect.name, queryToTake()), 'lines of Python'));
$('help').addEventListener('click', () => $('keys').showModal());

let inside = 0;  // elements that something is dragged over
const hasFiles = event => event.dataTransfer?.types.includes('Files');
for (const [name, by] of [['dragenter', 1], ['dragleave', -1]]) {
  addEventListener(name, event => {
    if (!hasFiles(event)) return;
    inside += by;
    $('drop').hidden = inside <= 0;
  });
}
addEventListener('dragover', event => hasFiles(event) && event.preventDefault());
addEventListener('drop', event => {
  if (!hasFiles(event)) return;
  event.preventDefault();
  inside = 0;
  $('drop').hidden = true;
  const files = [...event.dataTransfer.files];
  if (files.length) open(files);
});

theme.install($('theme'), () => {
  const colour = getComputedStyle($('canvas')).backgroundColor.match(/[\d.]+/g)?.slice(0, 3).map(part => part / 255);
  if (colour) viewer?.set({surround: colour});
});
if (viewer) {
  $('keylist').replaceChildren(...tools.listKeys());
  viewer.addEventListener('cursor', () => values());
  viewer.addEventListener('problem', event => fail(new Problem(event.detail)));
  for (const input of tools.modes.querySelectorAll('input')) input.addEventListener('change', () => { modeByHand = true; });
}
begin();
