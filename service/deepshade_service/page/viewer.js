// Two pictures in one view: zoomed, moved, exposed, wiped. Drawn only when something has changed.

import {KINDS} from './picture.js';
import {FRAGMENT, VERTEX} from './shader.js';

export const MODES = ['a', 'b', 'wipe', 'difference'];
const MAX_ZOOM = 64, MIN_SHOWN = 32;  // canvas pixels that stay in view
const SIDES = ['a', 'b'];
const TYPES = {
  half: ['R16F', 'RED', 'HALF_FLOAT'], float: ['R32F', 'RED', 'FLOAT'],
  bitmap: ['RGBA8', 'RGBA', 'UNSIGNED_BYTE'],
};

export class Viewer extends EventTarget {
  /** Draws into `canvas`. Events: `view` (zoom or place), `cursor` (the pixel under it), `problem`.
   *  Throws where there is no WebGL2. */
  constructor(canvas) {
    super();
    this.canvas = canvas;
    this.pictures = {a: null, b: null};
    this.state = {mode: 'a', exposure: 0, curve: 0, wipe: .5, surround: [.1, .1, .1]};
    this.zoom = 1;
    this.origin = [0, 0];
    this.fitted = true;
    this.cursor = null;
    this.start();
    canvas.addEventListener('webglcontextlost', event => event.preventDefault());
    canvas.addEventListener('webglcontextrestored', () => {
      this.start();
      for (const side of SIDES) if (this.pictures[side]) this.upload(side);
      this.draw();
    });
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.listen();
  }

  start() {
    const gl = this.canvas.getContext('webgl2', {alpha: false, antialias: false, depth: false});
    if (!gl) throw new Error('This browser shows no WebGL2, which draws the pictures here. Shading and'
      + ' downloads work; a browser with WebGL2, or hardware acceleration switched on, shows them.');
    this.gl = gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Error(`The shader doesn't link: ${gl.getProgramInfoLog(program)}`);
    gl.useProgram(program);
    gl.bindVertexArray(gl.createVertexArray());
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    this.at = name => gl.getUniformLocation(program, name);
    this.textures = {};
    SIDES.forEach((side, unit) => {
      this.textures[side] = gl.createTexture();
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.textures[side]);
      for (const name of ['TEXTURE_MIN_FILTER', 'TEXTURE_MAG_FILTER'])
        gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl[name], gl.NEAREST);
      gl.uniform1i(this.at(`pixels${side.toUpperCase()}`), unit);
    });
  }

  /** Show a picture (or null) at a side; the first one, and one of another frame, is fitted in. */
  show(side, picture) {
    const before = this.frame;
    this.pictures[side] = picture;
    if (picture) this.upload(side);
    if (this.frame && String(this.frame) !== String(before)) this.fit();
    this.draw();
  }

  upload(side) {
    const {gl} = this, picture = this.pictures[side];
    const most = Math.min(gl.getParameter(gl.MAX_TEXTURE_SIZE), 16384);
    if (picture.width > most || picture.height > most) {
      this.pictures[side] = null;
      this.tell('problem', `The picture is ${picture.width} × ${picture.height} pixels; this`
        + ` graphics card shows at most ${most} a side. Its answer can still be downloaded.`);
      return;
    }
    gl.activeTexture(gl.TEXTURE0 + SIDES.indexOf(side));
    const {bitmap} = picture;
    const [inner, format, type] = TYPES[bitmap ? 'bitmap' : picture.half ? 'half' : 'float']
      .map(name => gl[name]);
    const size = [picture.width, picture.height, bitmap ? 1 : picture.count];
    gl.texImage3D(gl.TEXTURE_2D_ARRAY, 0, inner, ...size, 0, format, type, bitmap ?? picture.planes);
  }

  /** Change what of `state` is given, and draw. */
  set(changes) {
    Object.assign(this.state, changes);
    this.draw();
  }

  get frame() { return (this.pictures.a ?? this.pictures.b)?.frame; }

  /** The whole frame, as large as it fits. */
  fit() {
    if (!this.frame) return;
    const [x, y, width, height] = this.frame, {canvas} = this;
    this.zoom = Math.min(canvas.width / width, canvas.height / height, MAX_ZOOM);
    this.origin = [(canvas.width - width * this.zoom) / 2 - x * this.zoom,
      (canvas.height - height * this.zoom) / 2 - y * this.zoom];
    this.fitted = true;
    this.moved();
  }

  /** Zoom to so many canvas pixels a pixel, about a place of the canvas (its middle). */
  zoomTo(zoom, about = [this.canvas.width / 2, this.canvas.height / 2]) {
    if (!this.frame) return;
    zoom = Math.max(Math.min(zoom, MAX_ZOOM), Math.min(1, MIN_SHOWN / Math.max(...this.frame.slice(2))));
    if (Math.abs(Math.log2(zoom / Math.round(zoom))) < .04) zoom = Math.round(zoom);  // whole ones catch
    this.origin = this.origin.map((o, i) => about[i] - (about[i] - o) * zoom / this.zoom);
    this.zoom = zoom;
    this.fitted = false;
    this.moved();
  }

  pan(dx, dy) {
    this.origin = [this.origin[0] + dx, this.origin[1] + dy];
    this.fitted = false;
    this.moved();
  }

  moved() {
    if (this.frame) {
      const size = [this.canvas.width, this.canvas.height];
      this.origin = this.origin.map((o, i) => {
        const start = this.frame[i] * this.zoom, length = this.frame[i + 2] * this.zoom;
        const kept = Math.min(MIN_SHOWN, length);
        const inside = Math.max(kept - length, Math.min(size[i] - kept, o + start)) - start;
        return this.zoom >= 1 ? Math.round(inside) : inside;
      });
    }
    this.draw();
    this.tell('view');
  }

  resize() {
    const {canvas} = this, ratio = devicePixelRatio || 1;
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width === width && canvas.height === height) return;
    const before = [canvas.width, canvas.height];
    [canvas.width, canvas.height] = [width, height];
    if (this.fitted) return this.fit();
    // what was in the middle stays there
    this.origin = this.origin.map((o, i) => o + ([width, height][i] - before[i]) / 2);
    this.moved();
  }

  draw() {
    this.frameAsked ??= requestAnimationFrame(() => {
      this.frameAsked = null;
      this.render();
    });
  }

  /** Until what was drawn is seen: browsers hold the next frame back while graphics are behind. A
   *  page that nobody sees draws nothing, and waits `most` ms. */
  seen(most = 300) {
    const turn = () => new Promise(resolve => requestAnimationFrame(resolve));
    return Promise.race([turn().then(turn), new Promise(resolve => setTimeout(resolve, most))]);
  }

  /** Draw now; the pixels can be read until the browser composes them. */
  render() {
    const {gl, canvas, state} = this;
    const {a, b} = this.pictures;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...state.surround, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (!a && !b) return;
    let mode = MODES.indexOf(state.mode);
    if (!b) mode = 0;
    if (!a) mode = 1;
    for (const [side, picture] of [['a', a ?? b], ['b', b ?? a]]) {
      gl.uniform4f(this.at(`${side}.box`), ...picture.window);
      gl.uniform2i(this.at(`${side}.size`), picture.width, picture.height);
      gl.uniform1i(this.at(`${side}.channels`), picture.count);
      gl.uniform1i(this.at(`${side}.kind`), KINDS.indexOf(picture.kind));
      gl.uniform2f(this.at(`${side}.range`), ...picture.range);
      gl.uniform1i(this.at(`${side}.srgb`), picture.bitmap ? 1 : 0);
      const order = [...picture.order, 0, 0, 0].slice(0, 4);
      gl.uniform4i(this.at(`${side}.order`), ...order);
    }
    gl.uniform2f(this.at('origin'), ...this.origin);
    gl.uniform1f(this.at('zoom'), this.zoom);
    gl.uniform1f(this.at('height'), canvas.height);
    gl.uniform1f(this.at('exposure'), 2 ** state.exposure);
    gl.uniform1i(this.at('curve'), state.curve);
    gl.uniform1i(this.at('mode'), mode);
    gl.uniform1f(this.at('wipe'), state.wipe * canvas.width);
    gl.uniform3f(this.at('surround'), ...state.surround);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    if (!this.begun) performance.mark('first picture');
    this.begun = true;
  }

  /** Put the cursor on a pixel of the frame, or nowhere (null); `seen` brings it into view. */
  point(pixel, seen = false) {
    this.cursor = pixel;
    if (pixel && seen) {
      const size = [this.canvas.width, this.canvas.height];
      const at = pixel.map((p, i) => (p + .5) * this.zoom + this.origin[i]);
      const by = at.map((p, i) => Math.max(0, MIN_SHOWN - p) - Math.max(0, p - size[i] + MIN_SHOWN));
      if (by[0] || by[1]) this.pan(...by);
    }
    this.tell('cursor', pixel);
  }

  /** The pixel of the frame at a place of the canvas, in its pixels. */
  pixelAt(place) { return place.map((p, i) => Math.floor((p - this.origin[i]) / this.zoom)); }

  listen() {
    const {canvas} = this, down = new Map();
    const place = event => {
      const box = canvas.getBoundingClientRect(), ratio = canvas.width / box.width;
      return [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio];
    };
    canvas.addEventListener('pointerdown', event => {
      canvas.setPointerCapture(event.pointerId);
      down.set(event.pointerId, place(event));
    });
    canvas.addEventListener('pointermove', event => {
      const to = place(event), from = down.get(event.pointerId);
      this.point(this.pixelAt(to));
      if (!from) return;
      const other = [...down].find(([id]) => id !== event.pointerId)?.[1];
      down.set(event.pointerId, to);
      if (!other) return this.pan(to[0] - from[0], to[1] - from[1]);
      const apart = p => Math.hypot(p[0] - other[0], p[1] - other[1]);
      this.pan((to[0] - from[0]) / 2, (to[1] - from[1]) / 2);
      if (apart(from) > 1) this.zoomTo(this.zoom * apart(to) / apart(from), other);
    });
    for (const name of ['pointerup', 'pointercancel'])
      canvas.addEventListener(name, event => down.delete(event.pointerId));
    canvas.addEventListener('pointerleave', () => down.size || this.point(null));
    canvas.addEventListener('wheel', event => {
      event.preventDefault();
      const lines = event.deltaY * (event.deltaMode ? 30 : 1);
      this.zoomTo(this.zoom * 2 ** (-lines / 240), place(event));
    }, {passive: false});
    canvas.addEventListener('dblclick', event => {
      if (this.fitted) this.zoomTo(Math.max(8, 2 * this.zoom), place(event));
      else this.fit();
    });
  }

  tell(name, detail) { this.dispatchEvent(new CustomEvent(name, {detail})); }
}
