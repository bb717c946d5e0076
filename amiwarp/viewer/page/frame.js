// Box, ticks and titles around a cloud, drawn so that texts never cover each other.

import { corners } from './camera.js';
import { text, ticks } from './canvas.js';

const TICK_PX = [40, 32]; // least distance between two ticks along a flat and an upright axis

// Draw the frame of a box between two corners. `axes` holds low, high and title of x, y and the third axis in the box; y
// points down in images.
export function drawFrame(context, projection, box, axes, [ink, paper], size, [width, height]) {
  const places = corners(box).map((corner) => projection.at(corner));
  const middle = projection.at([0, 1, 2].map((k) => (box[0][k] + box[1][k]) / 2));
  context.strokeStyle = context.fillStyle = ink;
  context.font = `${size}px system-ui, sans-serif`;
  context.lineWidth = 1;
  const farthest = places.reduce((least, place, k) => (place[2] < places[least][2] ? k : least), 0);
  for (const hidden of [false, true]) { // edges behind the points are pale, because they are drawn over them
    context.globalAlpha = hidden ? 0.18 : 0.55;
    context.beginPath();
    for (const axis of [0, 1, 2]) for (const [a, b] of edges(axis).filter((edge) => edge.includes(farthest) === hidden)) {
      context.moveTo(places[a][0], places[a][1]);
      context.lineTo(places[b][0], places[b][1]);
    }
    context.stroke();
  }
  context.globalAlpha = 1;
  const taken = [];
  const labels = [0, 1, 2].flatMap((axis) => axisLabels(places, middle, axis, axes[axis], size));
  for (const label of labels.filter((each) => each.title).concat(labels.filter((each) => !each.title))) {
    write(context, label, taken, size + 2, [width, height], paper);
  }
}

// Return the pairs of corners that form the four edges along an axis, low end first.
function edges(axis) {
  const step = [4, 2, 1][axis];
  return [0, 1, 2, 3, 4, 5, 6, 7].filter((k) => !(k & step)).map((k) => [k, k + step]);
}

// Return the labels of an axis, at its edge on the outline of the box: the lowest, for upright axes the leftmost.
function axisLabels(places, middle, axis, { low, high, title, flipped }, size) {
  const length = ([a, b]) => Math.hypot(places[a][0] - places[b][0], places[a][1] - places[b][1]);
  const all = edges(axis);
  const [a, b] = all[0];
  const upright = Math.abs(places[a][1] - places[b][1]) > 1.2 * Math.abs(places[a][0] - places[b][0]);
  const outer = ([p, q]) => (upright ? -(places[p][0] + places[q][0]) : places[p][1] + places[q][1]);
  const edge = all.reduce((best, each) => (outer(each) > outer(best) ? each : best));
  if (length(edge) < 34) return [];
  let [from, to] = edge.map((k) => places[k]);
  if (flipped) [from, to] = [to, from];
  const across = [to[1] - from[1], from[0] - to[0]].map((each) => each / length(edge));
  const centre = [(from[0] + to[0]) / 2, (from[1] + to[1]) / 2];
  const side = across[0] * (centre[0] - middle[0]) + across[1] * (centre[1] - middle[1]) < 0 ? -1 : 1;
  const out = across.map((each) => each * side);
  const at = (share, gap) => [0, 1].map((k) => from[k] + share * (to[k] - from[k]) + gap * out[k]);
  const labels = ticks(low, high, length(edge) / TICK_PX[Number(upright)]).map((value) => ({
    text: text(value), place: at((value - low) / (high - low), 6), out, from: at((value - low) / (high - low), 0),
  }));
  return [{ text: title, place: at(0.5, upright ? 4.3 * size : 2.9 * size), out, title: true, upright }, ...labels];
}

// Write a label, unless it would cover another one or leave the picture.
function write(context, label, taken, tall, [W, H], paper) {
  const width = context.measureText(label.text).width;
  let [x, y] = label.place;
  const turned = label.title && label.upright;
  const [w, h] = turned ? [tall, width] : [width, tall];
  if (label.title) {
    x = Math.max(w / 2 + 1, Math.min(W - w / 2 - 1, x));
    y = Math.max(h / 2 + 1, Math.min(H - h / 2 - 1, y));
  } else {
    x += (label.out[0] * w) / 2;
    y += (label.out[1] * h) / 2;
  }
  const box = [x - w / 2 - 2, y - h / 2 - 1, x + w / 2 + 2, y + h / 2 + 1];
  const covered = taken.some((b) => box[0] < b[2] && b[0] < box[2] && box[1] < b[3] && b[1] < box[3]);
  if (covered || (!label.title && (box[0] < 0 || box[1] < 0 || box[2] > W || box[3] > H))) return;
  taken.push(box);
  context.save();
  context.translate(x, y);
  if (turned) context.rotate(-Math.PI / 2);
  context.textAlign = 'center';
  context.textBaseline = 'middle';
  const fill = context.fillStyle;
  context.fillStyle = paper; // points do not cover texts
  context.fillRect(-width / 2 - 1, -tall / 2, width + 2, tall);
  context.fillStyle = fill;
  context.fillText(label.text, 0, 0);
  context.restore();
  if (label.from) {
    context.beginPath();
    context.moveTo(...label.from);
    context.lineTo(label.from[0] + 4 * label.out[0], label.from[1] + 4 * label.out[1]);
    context.stroke();
  }
}
