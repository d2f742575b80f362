// The page that shades: a picture comes in, settings change, the answer is looked at and taken along.

import {$, bytes, digits, el, plain, say} from './dom.js';
import * as drop from './drop.js';
import {pick} from './pick.js';
import {Picture, kindOf, share} from './picture.js';
import {apart, strays, valuesAt} from './readout.js';
import * as report from './report.js';
import {ask, json, Problem, Source} from './service.js';
import {Settings} from './settings.js';
import {curl, named, python} from './snippets.js';
import {copy, save} from './take.js';
import * as theme from './theme.js';
import {Tools} from './tools.js';
import {Viewer} from './viewer.js';
import {planInWords, timingInWords} from './words.js';

const ANSWER = 'answer', FIRST_SAMPLE = 'room';
const OF_THE_FILE = ['append', 'layer', 'multiply', 'half', 'compression'];  // not of its values
const SCENE = {median: 1, near: .1, far: 10};  // until the picture is measured
const effects = new Map();
let source = null, effect = null, answer = null;
let layers = new Map();  // index -> promise of a Picture
let chosen = {a: ANSWER, b: null}, chosenByHand = false, modeByHand = false;
let shading = false, again = false, stale = false, retrying;
let opening = 0, turn = 0;  // pictures that are under way, and the number of the last
let fresh = false;  // whether the answer to come is the first of its picture and effect

const settings = new Settings($('settings'), () => shade(), pickDistance);
const {viewer, tools} = makeViewer();

function makeViewer() {
  try {
    const viewer = new Viewer($('canvas'));
    const auto = () => (viewer.pictures.a ?? viewer.pictures.b)?.autoExposure() ?? 0;
    const tools = new Tools($('tools'), viewer, {choose, auto});
    return {viewer, tools};
  } catch (error) {
    say($('nothing'), error.message);
    return {};
  }
}

/* Pictures */

/** Open files or a sample, and shade. Whoever opens something else meanwhile gets that; a sample that
 *  nobody asked for is `optional`. */
async function open(files, sample, optional = false) {
  const opened = new Source(files, sample), mine = ++turn;
  report.clear();
  report.progress(0);
  opening++;
  try {
    await opened.open(report.progress);
  } catch (error) {
    if (mine === turn && !(optional && error.status === 404)) fail(error);
    return;
  } finally {
    opening--;
    report.busy();
  }
  if (mine !== turn) return;
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
  const isBeauty = layer => layer.attribute === 'beauty' || String(layer.channels) === 'R,G,B';
  $('multiplied').hidden = effect.light || !from.held.layers.some(isBeauty);
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
  const {layers: all, files} = source.held;
  const from = layer => files.length > 1 ? ` (${files[layer.file].name})` : '';
  const entries = all.map((layer, index) => [String(index), plain(layer.name + from(layer))]);
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
  const find = name => source.held.layers.findIndex(layer => layer.attribute === name);
  return ['depth', 'distance', 'position'].map(find).find(at => at >= 0);
}

/** The median depth of the picture, and the nearest and farthest: what lengths are measured by. */
async function measure() {
  const index = distances();
  if (index === undefined) return SCENE;
  try {
    const picture = await layer(index);
    const depth = pixel => Math.abs(picture.value(picture.order.at(-1), pixel));
    const depths = picture.sorted(depth).filter(value => value > 0);
    const [near, median, far] = [.02, .5, .98].map(part => share(depths, part));
    return near > 0 && far > near ? {near, median, far} : SCENE;
  } catch {
    return SCENE;  // what is wrong with it is said when it is shaded
  }
}

async function pickDistance() {
  const index = source && distances();
  return viewer && index !== undefined ? pick(viewer, await layer(index)) : null;
}

function layer(index) {
  if (!layers.has(index)) {
    const from = source, about = source.held.layers[index];
    const got = from.use(async name => {
      const response = await ask(`uploads/${name}/layers/${index}`);
      return Picture.from(await response.arrayBuffer(), kindOf(about, effects));
    }, report.progress);
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
    const {select} = tools.selects[side], old = stale && chosen[side] === ANSWER ? ', before the problem' : '';
    const name = `${select.selectedOptions[0]?.textContent ?? ''}${old}`;
    $(`name${side.toUpperCase()}`).textContent = viewer.pictures[side] ? name : shading ? 'shading …' : '';
  }
  tools.alone(!viewer.pictures.a || !viewer.pictures.b);
  const referred = answer && Object.values(chosen).some(value => source.held.layers[value]?.reference);
  const other = referred ? strays(effect.settings, source.held.settings, answer.plan) : '';
  $('apart').textContent = apart(viewer.pictures) + (other && `; the reference has ${other}`);
  $('canvas').setAttribute('aria-label', `A: ${$('nameA').textContent}. B: ${$('nameB').textContent}.`
    + ' Arrow keys move a cursor from pixel to pixel.');
  values();
}

function values() {
  if (viewer.cursor) $('values').value = valuesAt(viewer.pictures, viewer.cursor);
}

/* Shading */

/** What is asked for, as [name, value] pairs: to be taken along. */
function queryToTake() {
  const bundle = $('bundle').value ? [['bundle', $('bundle').value]] : [];
  const on = (id, name, value) => $(id).checked && !$(id).closest('[hidden]') ? [[name, value]] : [];
  return [...settings.query, ...bundle, ...new URLSearchParams($('more').value),
    ...on('append', 'append', '1'), ...on('multiply', 'multiply', '1'), ...on('float', 'half', 'false')];
}

/** The same to be looked at: the answer alone, as readExr takes it. */
const queryToSee = () =>
  [...queryToTake().filter(([name]) => !OF_THE_FILE.includes(name)), ['compression', 'none']];

/** The response to a request to shade. */
const request = pairs => source.use(name => {
  const query = new URLSearchParams([['upload', name], ...pairs]);
  return ask(`shade/${effect.name}?${query}`, {method: 'POST'});
}, report.progress);

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
  const timer = setTimeout(() => report.busy('Shading …'), 150);
  if (viewer && !answer) label();
  try {
    do {
      again = false;
      await shadeOnce();
    } while (again);
    stale = false;
  } catch (error) {
    stale = true;
    fail(error);
  } finally {
    clearTimeout(timer);
    shading = false;
    report.busy();
    if (viewer) label();
  }
  if (again) shade();
}

async function shadeOnce() {
  const asked = {source, effect}, start = performance.now();
  const response = await request(queryToSee());
  const body = await response.arrayBuffer();
  if (asked.source !== source || asked.effect !== effect) {
    again = true;
    return;
  }
  const picture = Picture.from(body, effect.light ? 'light' : 'factor');
  answer = picture;
  picture.plan = JSON.parse(picture.attributes['deepshade:plan']);
  report.clear();
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
  const name = named(source, effect.name);
  await request(queryToTake()).then(response => save(response, name)).catch(fail);
  $('download').disabled = false;
}

/** Say what went wrong; a service that is gone is asked again until it is back. */
function fail(error) {
  report.fail(error);
  if (error.kind !== 'unreachable') return;
  clearTimeout(retrying);
  retrying = setTimeout(() => report.failed() && (source && effect ? shade() : begin()), 2000);
}

/* The beginning */

function chooseEffect(name) {
  effect = effects.get(name);
  $('effect').value = name;
  const error = dssim => dssim == null ? '' : `, DSSIM ${digits(dssim, 3)}`;
  $('bundle').replaceChildren(el('option', {value: ''}, 'usual bundle'),
    ...effect.bundles.map(({name, dssim}) => el('option', {value: name}, name + error(dssim))));
}

async function begin() {
  const wanted = new URLSearchParams(location.hash.slice(1));
  if (!source && !opening) open(null, wanted.get('sample') ?? FIRST_SAMPLE, !wanted.get('sample'));
  try {
    const [samples, found, maps] = await Promise.all([json('samples'), json('effects'), json('environments')]);
    settings.environments = maps.map(map => map.name);
    const options = (list, read) => list.map(each => el('option', ...read(each)));
    $('sample').replaceChildren(el('option', {value: ''}, '–'),
      ...options(samples, name => [{value: name}, name]));
    $('sample').value = source?.sample ?? '';
    for (const each of found.filter(each => each.bundles.length)) effects.set(each.name, each);
    if (!effects.size) {
      say($('lacks'), 'The service is still loading …', 'note');
      return void setTimeout(begin, 500);
    }
    const all = [...effects.values()];
    $('effect').replaceChildren(...options(all, each => [{value: each.name}, each.title]));
    const most = all.reduce((best, each) => each.bundles.length > best.bundles.length ? each : best);
    chooseEffect(effects.has(wanted.get('effect')) ? wanted.get('effect') : most.name);
    await settle();
  } catch (error) {
    fail(error);
  }
}

/** #sample=…&effect=… of the address, so that a link leads to what it shows. */
function remember() {
  const state = {...(source?.sample ? {sample: source.sample} : {}), effect: effect.name};
  history.replaceState(null, '', `#${new URLSearchParams(state)}`);
}

$('open').addEventListener('click', () => $('files').click());
$('files').addEventListener('change', () => {
  if ($('files').files.length) open([...$('files').files]);
  $('files').value = '';  // so that the same file can be opened again
});
$('sample').addEventListener('change', () => $('sample').value && open(null, $('sample').value));
$('effect').addEventListener('change', () => {
  chooseEffect($('effect').value);
  noAnswer();
  remember();
  settle();
});
for (const id of ['bundle', 'more']) $(id).addEventListener('change', () => shade());
$('download').addEventListener('click', download);
const copies = {curl: [curl, 'a line for a shell'], python: [python, 'lines of Python']};
for (const [id, [text, what]] of Object.entries(copies))
  $(id).addEventListener('click', () => copy(text(source, effect.name, queryToTake()), what));
$('help').addEventListener('click', () => $('keys').showModal());

drop.install($('drop'), open);
theme.install($('theme'), surround => viewer?.set({surround}));
if (viewer) {
  $('keylist').replaceChildren(...tools.listKeys());
  viewer.addEventListener('cursor', () => values());
  viewer.addEventListener('problem', event => fail(new Problem(event.detail)));
  tools.modes.addEventListener('change', () => { modeByHand = true; });
}
begin();
