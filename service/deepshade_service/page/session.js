// A viewer's connection to a live session: comes back by itself, and knows the service's clock.

const PROTOCOL = 'deepshade.live.1';
const FIRST = 250, LONGEST = 2000;  // ms between attempts
const IN_VAIN = [4401, 4403, 4409, 4413, 4422];
const PING = 3000, SILENCE = 6000;  // ms; the service speaks each second
const SLACK = 1.2;  // a ping a little worse than the best counts too, or drift would never be heard

export class Session extends EventTarget {
  /** Events: `message` (a text message), `frame` (an ArrayBuffer), `open`, `lost` (why, and whether
   *  it is tried again). `want` says what is wanted, when it opens. */
  constructor(name, token, want) {
    super();
    Object.assign(this, {name, token, want, pause: FIRST, ahead: 0, soonest: Infinity, heard: 0, quiet: 0});
    this.connect();
    setInterval(() => this.watch(), 500);
  }

  connect() {
    const url = new URL(`${encodeURIComponent(this.name)}/view`, location.href);
    url.protocol = url.protocol.replace('http', 'ws');
    url.hash = '';
    const socket = new WebSocket(url, [PROTOCOL, ...this.token ? [`token.${this.token}`] : []]);
    socket.binaryType = 'arraybuffer';
    this.socket = socket;
    this.problem = null;
    this.heard = performance.now();
    socket.onopen = () => {
      this.soonest = Infinity;  // a service that has come back may be another one
      this.ask(this.want);
      for (const ms of [0, 300, 600]) setTimeout(() => this.ping(), ms);
    };
    socket.onmessage = ({data}) => {
      this.heard = performance.now();
      if (typeof data !== 'string') return this.tell('frame', data);
      const message = JSON.parse(data);
      if (message.type === 'pong') return this.compare(message);
      if (message.type === 'ping') return this.send({type: 'pong', t: message.t, clock: Date.now() / 1000});
      if (message.type === 'welcome') {
        this.pause = FIRST;
        this.tell('open', message);
      }
      if (message.type === 'problem' && message.id === undefined) this.problem = message.problem;
      this.tell('message', message);
    };
    socket.onclose = ({code}) => this.lose(code);
  }

  /** The connection is gone: say so, and come back unless that is in vain. */
  lose(code) {
    this.socket.onclose = this.socket.onmessage = null;
    const again = !IN_VAIN.includes(code);
    this.tell('lost', {code, again, problem: this.problem});
    if (!again) return;
    setTimeout(() => this.connect(), this.pause);
    this.pause = Math.min(LONGEST, 2 * this.pause);
  }

  /** Change what is wanted; it holds for the next connection too. */
  ask(want) {
    this.want = {...this.want, ...want};
    this.send({type: 'want', ...this.want});
  }

  acknowledge(id) { this.send({type: 'ack', id}); }

  send(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  ping() {
    this.pinged = performance.now();
    this.send({type: 'ping', t: Date.now() / 1000});
  }

  compare({t, clock}) {
    const now = Date.now() / 1000, took = now - t;
    if (!(took >= 0 && took < 60)) return;
    if (took <= SLACK * this.soonest) this.ahead = clock - (t + now) / 2;
    this.soonest = Math.min(this.soonest, took);
  }

  /** A connection that says nothing is broken, though no system has noticed yet. */
  watch() {
    if (this.socket.readyState === WebSocket.OPEN) {
      if (performance.now() - this.pinged > PING) this.ping();
      // twice in a row: what came while this page was busy is heard in between
      this.quiet = performance.now() - this.heard > SILENCE ? this.quiet + 1 : 0;
      if (this.quiet > 1) {
        this.socket.close();  // which the other side may never hear
        this.lose(1006);
      }
    }
  }

  /** Seconds since nothing was heard. */
  get silence() { return (performance.now() - this.heard) / 1000; }

  /** Seconds by which a time of the service's clock is past. */
  age(time) { return Math.max(0, Date.now() / 1000 + this.ahead - time); }

  tell(name, detail) { this.dispatchEvent(new CustomEvent(name, {detail})); }
}
