// Files that are dropped anywhere on the page.

/** `open` gets them; `overlay` is shown while some are held over the page. */
export function install(overlay, open) {
  let inside = 0;  // elements that something is dragged over
  const hasFiles = event => event.dataTransfer?.types.includes('Files');
  for (const [name, by] of [['dragenter', 1], ['dragleave', -1]]) {
    addEventListener(name, event => {
      if (!hasFiles(event)) return;
      inside += by;
      overlay.hidden = inside <= 0;
    });
  }
  addEventListener('dragover', event => hasFiles(event) && event.preventDefault());
  addEventListener('drop', event => {
    if (!hasFiles(event)) return;
    event.preventDefault();
    inside = 0;
    overlay.hidden = true;
    const files = [...event.dataTransfer.files];
    if (files.length) open(files);
  });
}
