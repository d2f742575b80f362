// Requests to the service, and what went wrong in words.

/** A problem document (RFC 9457) as an error: `message` says what is wrong, `fix` what to do. */
export class Problem extends Error {
  constructor(text, {fix = '', status = 0, kind = ''} = {}) {
    super(text);
    Object.assign(this, {fix, status, kind});
  }
}

/** The response, or a Problem. */
export async function ask(path, options) {
  let response;
  try {
    response = await fetch(path, options);
  } catch (error) {
    if (error.name === 'AbortError') throw error;
    throw unreachable();
  }
  if (!response.ok) throw problem(response.status, await response.text());
  return response;
}

export const json = async (path, options) => (await ask(path, options)).json();

/** A picture that the service keeps: the user's files, or one of its samples. */
export class Source {
  constructor(files, sample) {
    Object.assign(this, {files, sample});
    this.title = sample ?? files.map(file => file.name).join(', ');
    this.stem = (sample ?? files[0].name).replace(/\.exr$/i, '');
  }

  /** Sends the files, if it must, and describes what they hold; `progress` hears shares of 1. */
  async open(progress = () => {}) {
    this.held = this.sample ? await json(`uploads/${encodeURIComponent(this.sample)}`)
      : await send(this.files, progress);
    return this.held;
  }

  /** What `request` (of the upload's name) gives; an upload that is gone is sent again first. */
  async use(request, progress) {
    try {
      return await request(this.held.name);
    } catch (error) {
      if (error.status !== 410) throw error;
      this.reopening ??= this.open(progress).finally(() => this.reopening = null);
      await this.reopening;
      return request(this.held.name);
    }
  }
}

/** POST the files as a form. XMLHttpRequest, because fetch doesn't say how far it is. */
function send(files, progress) {
  const form = new FormData();
  for (const file of files) form.append('file', file, file.name);
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open('POST', 'uploads');
    request.upload.onprogress = event => event.lengthComputable && progress(event.loaded / event.total);
    request.onload = () => request.status < 300 ? resolve(JSON.parse(request.responseText))
      : reject(problem(request.status, request.responseText));
    // a file that was changed or moved meanwhile can't be read, and looks like a lost connection
    request.onerror = () => Promise.all(files.map(file => file.slice(0, 1).arrayBuffer())).then(
      () => reject(unreachable()),
      () => reject(new Problem('The file can no longer be read.', {fix: 'Open it again.'})));
    request.send(form);
  });
}

function problem(status, text) {
  try {
    const {detail, fix, type} = JSON.parse(text);
    return new Problem(detail ?? `HTTP ${status}`, {fix, status, kind: type?.split(':').pop()});
  } catch {
    return new Problem(`The answer is HTTP ${status}.`, {status});
  }
}

const unreachable = () => new Problem(`The service at ${location.origin} doesn't answer.`,
  {fix: 'Is it still running? This page goes on when it is back.', kind: 'unreachable'});
