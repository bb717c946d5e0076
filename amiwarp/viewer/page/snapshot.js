// Pictures to publish: the clouds or the images as they are seen, with title, legend, colour bars and a caption.

import { painted } from './pictures.js';

const LINE = 20; // height of a line of text [px]
const GAP = 12;
const BAR = 10;
const LEAST_PX = 320; // width from which an image is not enlarged
const FONT = '13px system-ui, sans-serif';

const DPI = 96; // pixels of the page per inch

// Return the check sum of bytes that PNG uses.
function checkSum(bytes) {
  let sum = 0xffffffff;
  for (const byte of bytes) {
    sum ^= byte;
    for (let k = 0; k < 8; k++) sum = sum & 1 ? (sum >>> 1) ^ 0xedb88320 : sum >>> 1;
  }
  return (sum ^ 0xffffffff) >>> 0;
}

// Save a picture as PNG that says how many of its pixels are an inch, so that its texts are as large in a document.
async function savePng(canvas, ratio, name, download) {
  const blob = await new Promise((done) => canvas.toBlob(done));
  const chunk = new DataView(new ArrayBuffer(21));
  const perMetre = Math.round((DPI * ratio) / 0.0254);
  chunk.setUint32(0, 9);
  [...'pHYs'].forEach((letter, k) => chunk.setUint8(4 + k, letter.charCodeAt(0)));
  chunk.setUint32(8, perMetre);
  chunk.setUint32(12, perMetre);
  chunk.setUint8(16, 1); // per metre
  chunk.setUint32(17, checkSum(new Uint8Array(chunk.buffer, 4, 13)));
  const head = 33; // bytes before the second chunk
  download(name, new Blob([blob.slice(0, head), chunk.buffer, blob.slice(head)], { type: blob.type }));
}

// Return a context of a new picture, filled with the background.
function sheet(width, height, ratio = 1) {
  const style = window.getComputedStyle(document.querySelector('.clouds canvas'));
  const canvas = Object.assign(document.createElement('canvas'), { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  const context = canvas.getContext('2d');
  context.fillStyle = style.getPropertyValue('--paper');
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.scale(ratio, ratio);
  context.font = FONT;
  context.fillStyle = style.getPropertyValue('--ink');
  return context;
}

// Draw a gradient that CSS describes.
function bar(context, css, x, y, width) {
  const stops = css.match(/rgb\([^)]*\)/g) || [];
  const fill = context.createLinearGradient(x, 0, x + width, 0);
  stops.forEach((colour, k) => fill.addColorStop(k / (stops.length - 1), colour));
  context.save();
  context.fillStyle = fill;
  context.fillRect(x, y, width, BAR);
  context.restore();
}

// Return the lines of texts that are at most as wide as the picture.
function wrapped(context, texts, width) {
  const add = (lines, word) => {
    const longer = `${lines.at(-1)} ${word}`;
    return context.measureText(longer).width > width ? [...lines, word] : [...lines.slice(0, -1), longer];
  };
  return texts.map((text) => text.split(' ')).flatMap(([first, ...words]) => words.reduce(add, [first]));
}

// Save the clouds as they are seen; `words` are the lines of the caption, the legend comes from the page.
export function savePicture(name, words, state, download) {
  const canvas = document.querySelector('.clouds canvas');
  const ratio = state.get('picture_scale');
  const width = canvas.clientWidth;
  const seen = document.getElementById('events').textContent; // with a slice, fewer events than the server draws
  const said = words.map((each) => (/^[\d,.]+ events/.test(each) ? seen : each));
  const lines = wrapped(sheet(1, 1), said, width - 2 * GAP);
  const context = sheet(width, canvas.clientHeight + (lines.length + 1) * LINE + GAP, ratio);
  context.drawImage(canvas.pictureAt(ratio), 0, 0, width, canvas.clientHeight);
  let y = canvas.clientHeight + LINE;
  let x = GAP;
  const write = (text) => {
    context.fillText(text, x, y);
    x += context.measureText(text).width + 8;
  };
  const legend = state.get('legend');
  write(legend.title);
  if (legend.bar) {
    write(legend.low);
    bar(context, legend.bar, x, y - BAR, 160);
    x += 168;
    write(legend.high);
  }
  for (const row of document.querySelectorAll('#legend .row')) {
    const mark = row.querySelector('i');
    if (mark) {
      const [ink, size] = [context.fillStyle, mark.getBoundingClientRect()];
      context.fillStyle = window.getComputedStyle(mark).backgroundColor;
      context.fillRect(x, y - 5 - size.height / 2, size.width, size.height);
      context.fillStyle = ink;
      x += size.width + 4;
    }
    write(row.textContent.trim());
    x += 8;
  }
  for (const line of lines) context.fillText(line, GAP, (y += LINE));
  savePng(context.canvas, ratio, name, download);
}

// Save the images as they are seen, each pixel as a square, with their colour bars.
export function saveImages(name, words, state, download) {
  const both = state.get('turn_ms') || state.get('beside') ? [['before', 'image_scale']] : [];
  const shown = [...both, ['after', 'after_scale']].filter(([key]) => state.get(key));
  if (!shown.length) return;
  const { width, height, step } = state.get('after');
  const ratio = state.get('picture_scale');
  const size = Math.max(1, Math.ceil(LEAST_PX / width));
  const [w, h] = [width * size, height * size];
  const whole = shown.length * (w + GAP) + GAP;
  const lines = wrapped(sheet(1, 1), [...words, ...(step > 1 ? [`largest values in squares of ${step} px`] : [])], whole - 2 * GAP);
  const top = LINE + GAP;
  const context = sheet(whole, top + h + 4 * LINE + lines.length * LINE + GAP, ratio);
  context.imageSmoothingEnabled = false;
  shown.forEach(([key, scale], k) => {
    const x = GAP + k * (w + GAP);
    const title = key === 'before' ? 'against-title' : 'after-title';
    context.fillText(document.getElementById(title).textContent.trim(), x, LINE);
    context.drawImage(painted(state.get(key)), x, top, w, h);
    const y = top + h + 6;
    const { bar: css, ticks, title: quantity, square } = state.get(scale);
    if (square) {
      context.drawImage(painted(square), x, y, 3 * LINE, 3 * LINE);
      [quantity, `right: OFF, 0 to ${square.high}`, `up: ON, 0 to ${square.high}`].forEach((text, row) => {
        context.fillText(text, x + 3 * LINE + 8, y + 14 + row * LINE);
      });
      return;
    }
    bar(context, css, x, y, w);
    let free = -Infinity;
    for (const [at, text] of ticks) {
      const wide = context.measureText(text).width;
      const left = x + at * (w - wide);
      if (left > free) context.fillText(text, left, y + BAR + 14);
      free = Math.max(free, left + wide + 6);
    }
    context.fillText(quantity, x, y + BAR + 14 + LINE);
  });
  lines.forEach((line, k) => context.fillText(line, GAP, top + h + 4 * LINE + (k + 0.8) * LINE));
  savePng(context.canvas, ratio, name, download);
}
