// Picture of the clouds as they are seen, with a caption and the legend.

const LINE = 20;

// Save the picture; `words` are the lines of the caption, `legend` rows come from the page.
export async function savePicture(name, words, download) {
  const canvas = document.querySelector('.clouds canvas');
  const style = window.getComputedStyle(canvas);
  const ratio = canvas.width / canvas.clientWidth;
  const legend = [...document.querySelectorAll('#legend .row')];
  const lines = words.length + (legend.length ? 1 : 0);
  const out = document.createElement('canvas');
  out.width = canvas.width;
  out.height = canvas.height + Math.round((lines * LINE + 10) * ratio);
  const context = out.getContext('2d');
  context.fillStyle = style.getPropertyValue('--paper');
  context.fillRect(0, 0, out.width, out.height);
  context.drawImage(canvas, 0, 0);
  context.scale(ratio, ratio);
  context.font = '13px system-ui, sans-serif';
  const ink = style.getPropertyValue('--ink');
  let y = canvas.clientHeight + LINE;
  for (const line of words) {
    context.fillStyle = ink;
    context.fillText(line, 12, y);
    y += LINE;
  }
  let x = 12;
  for (const row of legend) {
    const mark = row.querySelector('i');
    if (mark) {
      context.fillStyle = window.getComputedStyle(mark).backgroundColor;
      context.fillRect(x, y - 10, 11, 11);
      x += 16;
    }
    context.fillStyle = ink;
    context.fillText(row.textContent.trim(), x, y);
    x += context.measureText(row.textContent.trim()).width + 16;
  }
  download(name, await new Promise((resolve) => out.toBlob(resolve, 'image/png')), 'image/png');
}
