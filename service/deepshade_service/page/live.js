// The page that watches: what a publisher streams, how old it is, and when it stands still.

import {$, bytes, el, plain, say} from './dom.js';
import {REST, decode, readFrame} from './frame.js';
import {Picture} from './picture.js';
import {apart, valuesAt} from './readout.js';
import {json} from './service.js';
import {Session} from './session.js';
import * as theme from './theme.js';
import {Tools} from './tools.js';
import {Viewer} from './viewer.js';
import {planInWords} from './words.js';

const FRESH = 1000;  // ms for which a frame counts as now
const DEAF = 2.5;  // seconds without a word from the service, which speaks each second
const GRAPH = 30, TALL = 500;  // seconds, and ms of age
const LINES = 40;  // of what happened

const name = decodeURIComponent(location.pathname.split('/').pop());
const token = new URLSearchParams(location.hash.slice(1)).get('token');
const light = new Map();  // effect -> whether its answer is radiance
const drawn = [];  // {at, age} of frames, in ms
const got = [];  // {at, size} of messages
let exposedFor = '';  // the effect that the exposure suits
let waiting = null, decoding = false, paused = false, held = 0;
let shown = null;  // the frame that is seen: its `time`, `flags`, when it was drawn
let status = null, link = 'connecting', why = '';

$('title').textContent = name;
document.title = `${plain(name)} · deepshade live`;
const {viewer, tools} = makeViewer();
const session = new Session(name, token, {moving: 'jpeg', rest: 'deflate'});

function makeViewer() {
  try {
    const viewer = new Viewer($('canvas'));
    const tools = new Tools($('tools'), viewer, {
      choose: () => {},
      auto: () => viewer.pictures.a?.bitmap ? viewer.state.exposure : viewer.pictures.a?.autoExposure() ?? 0,
    });
    return {viewer, tools};
  } catch (error) {
    say($('nothing'), error.message);
    return {};
  }
}

/* Frames: the latest wins here too */

session.addEventListener('frame', ({detail}) => {
  got.push({at: performance.now(), size: detail.byteLength});
  waiting = detail;
  if (!decoding) decodeAll();
});

async function decodeAll() {
  decoding = true;
  while (waiting) {
    const next = waiting;
    waiting = null;
    try {
      const frame = readFrame(next);
      if (!paused && viewer) await show(frame);
      session.acknowledge(frame.id);
    } catch (error) {
      happened(`A frame can't be shown: ${error.message}`);
      await new Promise(resolve => setTimeout(resolve, 200));
    }
  }
  decoding = false;
}

async function show(frame) {
  const parts = await decode(frame, $('effect').value);
  const isLight = light.get(parts.effect) ?? !parts.names.includes('Y');
  const before = viewer.pictures.a;
  const picture = new Picture(parts, isLight ? 'light' : 'factor');
  viewer.show('a', picture);
  if (!picture.bitmap && exposedFor !== parts.effect && !tools.touched) {  // 8 bits say too little
    tools.expose(isLight ? picture.autoExposure() : 0);
    exposedFor = parts.effect;
  }
  if (before !== viewer.pictures.b) before?.bitmap?.close();
  const now = performance.now(), again = shown?.id === frame.id;
  shown = {id: frame.id, time: frame.time, flags: frame.flags, at: again ? shown.at : now};
  if (!again) drawn.push({at: now, age: 1000 * session.age(frame.time)});
  $('hold').disabled = false;
  $('nameA').textContent = `live: ${parts.effect}`;
  $('dropped').value = frame.about.dropped;
  $('age').title = `${Math.round(frame.about.age_ms)} ms when the service sent it`;
  values();
  await viewer.seen();  // acknowledged when seen, or slow graphics would build up lag
}

/* What the service says */

session.addEventListener('open', () => {
  if (link !== 'connecting') happened('Connected again.');
  link = 'open';
  why = '';
  $('problem').hidden = true;
  if (!light.size) json('../effects').then(all => all.forEach(each => light.set(each.name, each.light)), () => {});
  update();
});

session.addEventListener('lost', ({detail: {code, again, problem}}) => {
  const reason = problem ? [problem.detail, problem.fix].filter(Boolean).join('. ')
    : code === 1012 ? 'The service restarts.' : 'The service does not answer.';
  const ended = status?.publisher === 'ended';
  if (link === 'open') happened(ended ? 'The session has ended.' : `Connection lost: ${reason}`);
  link = ended || code === 4404 ? 'ended' : again ? 'lost' : 'refused';
  why = reason;
  if (!again) say($('problem'), plain(reason), 'problem');
  update();
});

session.addEventListener('message', ({detail}) => {
  if (detail.type === 'status') {
    if (status && detail.publisher !== status.publisher && detail.publisher !== 'ended')
      happened(detail.publisher === 'gone' ? 'The publisher has gone.' : 'The publisher is back.');
    if (status?.size && String(detail.size) !== String(status.size))
      happened(`Now ${detail.size.join(' × ')} pixels.`);
    status = detail;
    offerEffects(detail.effects);
    update();
  } else if (detail.type === 'about') {
    const told = ([effect, plan]) =>
      planInWords(plan).map((sentence, index) => el('li', {}, `${index ? '' : `${effect}: `}${sentence}`));
    $('plan').replaceChildren(...Object.entries(detail.effects).flatMap(told));
  } else if (detail.type === 'problem' && detail.id !== undefined) {
    happened(`Frame ${detail.id}: ${detail.problem.detail}`);
  }
});

function offerEffects(names) {
  const have = [...$('effect').options].map(option => option.value);
  if (String(have) === String(names)) return;
  const before = $('effect').value;
  $('effect').replaceChildren(...names.map(each => el('option', {value: each}, each)));
  if (names.includes(before)) $('effect').value = before;
}

/* What is said */

/** [state, text]: a picture that stands still must not look alive. */
function judge() {
  const age = shown ? session.age(shown.time) : 0, old = shown ? ` The picture is ${seconds(age)} old.` : '';
  if (link === 'ended') return ['frozen', `No session “${plain(name)}” now; it is seen when it begins.${old}`];
  if (link === 'refused') return ['frozen', `Refused.${old}`];
  if (link === 'lost') return ['frozen', `Frozen: ${plain(why)} Trying again.${old}`];
  if (link === 'connecting') return ['waiting', 'Connecting …'];
  if (session.silence > DEAF) return ['frozen', `Frozen: no word from the service for ${seconds(session.silence)}.${old}`];
  if (status?.publisher === 'gone') return ['frozen', `Frozen: the publisher has gone.${old}`];
  if (paused) return ['paused', `Paused here.${old}`];
  if (!shown) return ['waiting', 'Waiting for the first frame …'];
  if (performance.now() - shown.at < FRESH) return ['live', 'Live'];
  return ['rest', `At rest, ${seconds(age)} old${shown.flags & REST ? '' : ', not sharp yet'}`];
}

const seconds = value => value < 60 ? `${value.toFixed(value < 10 ? 1 : 0)} s`
  : `${Math.floor(value / 60)} min ${Math.floor(value % 60)} s`;

let spoken = '';

function update() {
  const [state, text] = judge(), now = performance.now();
  document.body.dataset.state = state;
  $('badge').textContent = text;
  // a live region that counts seconds would never be silent: it only speaks when the state changes
  $('badge').setAttribute('aria-live', state === spoken ? 'off' : 'polite');
  spoken = state;
  while (drawn.length && drawn[0].at < now - 1000 * GRAPH) drawn.shift();
  while (got.length && got[0].at < now - 1000) got.shift();
  const last = drawn.filter(each => each.at > now - 1000);
  $('fps').value = last.length;
  const ages = last.map(each => each.age).sort((a, b) => a - b);
  const age = ages.length ? ages[ages.length >> 1] : shown ? 1000 * session.age(shown.time) : NaN;
  $('age').value = Number.isNaN(age) ? '–' : age < 1000 ? `${Math.round(age)} ms` : seconds(age / 1000);
  $('rate').value = `${bytes(got.reduce((sum, each) => sum + each.size, 0))}/s`;
  $('shaded').value = status?.fps ?? '–';
  $('viewers').value = status?.viewers ?? '–';
  if (status) $('dropped').value = status.dropped;
  say($('size'), status?.size ? `${status.size.join(' × ')} pixels`
    + `${String(status.full) === String(status.size) ? '' : ` of ${status.full.join(' × ')}`}`
    + `, ${bytes(status.in_bytes_s)}/s from the publisher.` : '', 'note');
  graph(now);
}

/** Ages over time: a dot a frame, gaps where nothing came. */
function graph(now) {
  const canvas = $('graph'), ratio = devicePixelRatio || 1;
  const width = canvas.width = canvas.clientWidth * ratio, height = canvas.height = canvas.clientHeight * ratio;
  const context = canvas.getContext('2d');
  context.fillStyle = getComputedStyle(canvas).color;
  for (const {at, age} of drawn) {
    const x = width * (1 - (now - at) / (1000 * GRAPH));
    const tall = Math.max(ratio, height * Math.min(1, age / TALL));
    context.fillRect(x, height - tall, ratio, tall);
  }
}

function happened(text) {
  const time = new Date().toLocaleTimeString('en-GB');
  $('log').prepend(el('li', {}, el('time', {}, time), ` ${plain(text)}`));
  while ($('log').children.length > LINES) $('log').lastChild.remove();
}

function values() {
  if (!viewer) return;
  if (viewer.cursor) $('values').value = valuesAt(viewer.pictures, viewer.cursor);
  $('apart').textContent = apart(viewer.pictures);
}

/* What can be done */

$('moving').addEventListener('change', () => session.ask({moving: $('moving').value}));
$('effect').addEventListener('change', () => session.ask({shows: $('effect').value}));
$('hold').addEventListener('click', () => {
  viewer.show('b', viewer.pictures.a);
  held++;
  tools.alone(false);
  $('nameB').textContent = `held ${new Date().toLocaleTimeString('en-GB')}`;
  if (held === 1) tools.mode('wipe');
});
$('pause').addEventListener('click', () => {
  paused = !paused;
  $('pause').setAttribute('aria-pressed', paused);
  $('pause').textContent = paused ? 'Go on' : 'Pause';
  update();
});
$('help').addEventListener('click', () => $('keys').showModal());
theme.install($('theme'), surround => viewer?.set({surround}));
if (viewer) {
  $('keylist').replaceChildren(...tools.listKeys());
  viewer.addEventListener('cursor', values);
  viewer.addEventListener('problem', event => say($('problem'), event.detail, 'problem'));
}
setInterval(update, 250);
update();
