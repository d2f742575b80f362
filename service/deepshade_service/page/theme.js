// Light, dark, or as the system is; remembered here where the browser allows it.

const NAMES = {'': 'Auto', light: 'Light', dark: 'Dark'};

/** Makes `button` turn from one to the next; `surround` hears what colour is around the picture then,
 *  as three shares of 1, and when the system changes. */
export function install(button, surround) {
  const changed = () => surround(getComputedStyle(document.querySelector('.view')).backgroundColor
    .match(/[\d.]+/g).slice(0, 3).map(part => part / 255));
  const order = Object.keys(NAMES);
  let theme = order.includes(read()) ? read() : '';
  const apply = () => {
    document.documentElement.dataset.theme = theme;
    button.textContent = NAMES[theme];
    button.setAttribute('aria-label', `Colours: ${NAMES[theme]}`);
    button.title = 'Colours: as the system, light or dark';
    changed();
  };
  button.addEventListener('click', () => {
    theme = order[(order.indexOf(theme) + 1) % order.length];
    try { localStorage.setItem('theme', theme); } catch { /* then it lasts as long as the page */ }
    apply();
  });
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', changed);
  apply();
}

function read() {
  try { return localStorage.getItem('theme') ?? ''; } catch { return ''; }
}
