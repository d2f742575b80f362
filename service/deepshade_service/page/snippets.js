// The request that was made, as a line for a shell and as lines of Python.

// Names that a terminal or an editor might act on, or show as what they are not.
const STRANGE = /[\u0000-\u001f\u007f-\u009f\u200e\u200f\u202a-\u202e\u2066-\u2069]/;

const safe = name => STRANGE.test(name) ? 'input.exr' : name;
const here = name => /^[-~@]/.test(name) ? `./${name}` : name;

/** In single quotes, for sh. */
export const quoted = text => /^[\w./:=%?-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`;

/** A literal of Python, which reads JSON's strings and numbers as they are. */
const literal = value => typeof value === 'boolean' ? (value ? 'True' : 'False') : JSON.stringify(value);

/** What an answer of these files is called. */
export const named = (source, effect) => `${here(safe(source.stem))}_${effect}.exr`;

export function curl(source, effect, query, origin = location.origin) {
  const parameters = new URLSearchParams(query);
  const lines = ['curl --fail-with-body'];
  if (source.sample) {
    parameters.set('upload', source.sample);
    lines[0] += ' -X POST';
  }
  for (const file of source.files ?? []) {
    const name = here(safe(file.name)).replace(/["\\]/g, '\\$&');
    lines.push(`-F ${quoted(`file=@"${name}"`)}`);
  }
  const asked = String(parameters);
  lines.push(`-o ${quoted(named(source, effect))}`);
  lines.push(quoted(`${origin}/shade/${effect}${asked && `?${asked}`}`));
  return lines.join(' \\\n  ');
}

export function python(source, effect, query, origin = location.origin) {
  const options = Object.entries(asOptions(query)).map(([name, value]) => `${name}=${value}`);
  const names = source.sample ? [`samples/${source.sample}.exr`]
    : source.files.map(file => here(safe(file.name)));
  const picture = names.length === 1 ? literal(names[0]) : `[${names.map(literal).join(', ')}]`;
  const more = options.length ? `, Options(${options.join(', ')})` : '';
  return [
    `from deepshade_client import Client${options.length ? ', Options' : ''}`,
    '',
    `with Client(${literal(origin)}) as client:`,
    `    answer = client.shade(${literal(effect)}, ${picture}${more})`,
    `    answer.save(${literal(named(source, effect))})`,
    '    print(answer.facts.get("warnings", "no warnings"), answer.timing)',
  ].join('\n');
}

/** The query's [name, value] pairs as arguments of the client's Options. */
function asOptions(query) {
  const options = {}, lists = new Set(['axes', 'derive']), mapping = {};
  const flags = new Set(['append', 'multiply', 'half', 'strict', 'trust']);
  for (const [name, value] of query) {
    if (name === 'map') mapping[value.slice(0, value.indexOf('='))] = value.slice(value.indexOf('=') + 1);
    else if (lists.has(name)) (options[name] ??= []).push(value);
    else if (flags.has(name)) options[name] = /^(1|true|yes|on)$/i.test(value);
    else options[name] = /^-?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$/i.test(value) ? Number(value) : value;
  }
  if (Object.keys(mapping).length) options.mapping = mapping;
  return Object.fromEntries(Object.entries(options).map(([name, value]) => [name, literal(value)]));
}
