// Box, numbers and titles around a cloud. The numbers of an axis are at the outline of the box, where no point is behind
// them. Where the outline is out of the picture, they are where the lines of their values enter the picture.

import { MARGIN, corners, seenMiddle } from './camera.js';
import { text, ticks } from './canvas.js';

const TICK_PX = [40, 32]; // least distance between two ticks along a flat and an upright axis
const SHORTEST_PX = 12; // length in the picture below which an axis has no numbers: the camera looks along it
const GAP_PX = 6; // between the box and its numbers, and between these and the title
const NEAR = [0, 0.7]; // distances of numbers from their places beyond the gap [heights of a number]
const FAR = [0, 0.7, 1.4, 2.1, 2.8]; // where numbers of another axis are in the way
const COARSE = 256; // steps in which the seen part of an axis is searched: at the largest zoom it is about 1/60 of the axis
const FINE = 64; // steps within these at its ends

// Draw the frame of a box between two corners, and return its labels. `axes` holds of x, y and the third axis the values at
// the low and the high end of the box, and the title.
export function drawFrame(context, projection, box, axes, [ink, paper], size, [width, height]) {
  const sheet = [0, MARGIN.top - 4, width, height];
  context.strokeStyle = context.fillStyle = ink;
  context.font = `${size}px system-ui, sans-serif`;
  context.lineWidth = 1;
  context.save();
  context.beginPath();
  context.rect(sheet[0], sheet[1], sheet[2] - sheet[0], sheet[3] - sheet[1]);
  context.clip(); // the title of the cloud stays free
  drawEdges(context, corners(box).map((corner) => projection.at(corner)));
  context.restore();
  const measure = (words) => [context.measureText(words).width, size + 2];
  const taken = [];
  const found = [2, 0, 1].map((axis) => ({ axis, ...bestRow(projection, box, axis, axes[axis].ends, sheet, measure, taken) }));
  const titles = found.map(({ axis, row }) => row && titleOf(row, axes[axis].title, axis, sheet, measure, taken));
  const labels = [...found.flatMap(({ numbers }) => numbers), ...titles.filter(Boolean)];
  for (const label of labels) write(context, label, paper);
  return labels;
}

function drawEdges(context, places) {
  const farthest = places.reduce((least, place, k) => (place[2] < places[least][2] ? k : least), 0);
  for (const hidden of [false, true]) { // edges behind the points are pale, because they are drawn over them
    context.globalAlpha = hidden ? 0.18 : 0.55;
    context.beginPath();
    for (const step of [4, 2, 1]) for (const k of places.keys()) {
      if (k & step || [k, k + step].includes(farthest) !== hidden) continue;
      context.moveTo(places[k][0], places[k][1]);
      context.lineTo(places[k + step][0], places[k + step][1]);
    }
    context.stroke();
  }
  context.globalAlpha = 1;
}

// Return the row of places for the numbers of an axis on which two of them fit, and these numbers. They are added to the
// taken places.
function bestRow(projection, box, axis, ends, sheet, measure, taken) {
  let best = { row: null, numbers: [] };
  const { edges, inside } = bases(projection, box, axis);
  const passes = [
    [edges, NEAR, false], [edges, FAR, false], [edges, NEAR, true], [inside, NEAR, false], [inside, NEAR, true],
  ];
  for (const [lines, gaps, sides] of passes) {
    for (const base of best.numbers.length > 1 ? [] : lines) {
      const row = rowOn(projection, box, axis, base, sheet, sides);
      const numbers = row ? fittingNumbers(row, axis, ends, gaps, sheet, measure, taken) : [];
      if (row && (!best.row || numbers.length > best.numbers.length)) best = { row, numbers };
      if (numbers.length > 1) break;
    }
  }
  taken.push(...best.numbers.map((number) => number.box));
  return best;
}

// Return the lines along an axis that may carry its numbers, the best first. Each has a corner and an axis `inward`, along
// which the lines of the values lead from it to the place `far` over a face that is seen. `edges` are at the outline of the
// box, between a face that is seen and one that is not: the lowest is first, for upright axes the leftmost. `inside` are
// in the plane through the middle of what is seen, for a camera so close that no such face is in the picture.
function bases(projection, box, axis) {
  const camera = projection.away.map((part) => part / Math.max(projection.depth, 1e-9));
  const seen = [0, 1, 2].map((k) => [camera[k] < box[0][k], camera[k] > box[1][k]]);
  const [i, j] = [0, 1, 2].filter((k) => k !== axis);
  const middle = seenMiddle(projection).map((place, k) => Math.max(box[0][k], Math.min(box[1][k], place)));
  const edges = [];
  const inside = [];
  for (const ends of [[0, 0], [0, 1], [1, 0], [1, 1]]) {
    const faces = [seen[i][ends[0]], seen[j][ends[1]]];
    const [inward, end] = faces[0] ? [j, ends[1]] : [i, ends[0]];
    const corner = [0, 0, 0];
    corner[i] = box[ends[0]][i];
    corner[j] = box[ends[1]][j];
    if (faces[0] !== faces[1]) edges.push({ corner, inward, far: box[1 - end][inward] });
  }
  for (const [inward, still] of [[i, j], [j, i]]) for (const end of [0, 1]) {
    const corner = [0, 0, 0];
    corner[still] = middle[still];
    corner[inward] = box[end][inward];
    inside.push({ corner, inward, far: box[1 - end][inward] });
  }
  const upright = isUpright(projection, box, axis);
  const out = ({ corner }) => {
    const [x, y] = projection.at(corner.map((place, k) => (k === axis ? (box[0][k] + box[1][k]) / 2 : place)));
    return upright ? -x : y;
  };
  const outer = (one, other) => out(other) - out(one);
  return { edges: edges.sort(outer), inside: inside.sort(outer) };
}

function isUpright(projection, box, axis) {
  const [a, b] = box.map((end) => projection.at(end.map((place, k) => (k === axis ? place : (box[0][k] + box[1][k]) / 2))));
  return Math.abs(a[1] - b[1]) > 1.2 * Math.abs(a[0] - b[0]);
}

// Return the seen part of a line along an axis: the shares of the axis at its ends, `at` with the place of a share, its
// length [px], and the direction out of the box; null if it is not seen, or too short. Without `sides`, a flat axis has no
// numbers at the left and right border, which are for upright axes, and these have none at the others.
function rowOn(projection, box, axis, { corner, inward, far }, sheet, sides) {
  const upright = isUpright(projection, box, axis);
  const place = (share, end) => {
    const point = [...corner];
    point[axis] = box[0][axis] + share * (box[1][axis] - box[0][axis]);
    if (end) point[inward] = far;
    return projection.at(point).slice(0, 2);
  };
  const at = (share) => {
    const [near, end] = [place(share, false), place(share, true)];
    const entered = entry(near, end, sheet);
    if (!entered || entered === near || sides) return entered;
    const k = upright ? 1 : 0;
    return Math.min(Math.abs(entered[k] - sheet[k]), Math.abs(entered[k] - sheet[k + 2])) < 0.5 ? null : entered;
  };
  const shares = (from, to, count) => Array.from({ length: count + 1 }, (_, k) => from + (k / count) * (to - from)).filter(at);
  const coarse = shares(0, 1, COARSE);
  if (!coarse.length) return null;
  const fine = shares(Math.max(0, coarse[0] - 1 / COARSE), Math.min(1, coarse.at(-1) + 1 / COARSE), FINE);
  const ends = [Math.min(coarse[0], fine[0] ?? 1), Math.max(coarse.at(-1), fine.at(-1) ?? 0)];
  const [from, to] = ends.map(at);
  const length = Math.hypot(to[0] - from[0], to[1] - from[1]);
  if (length < SHORTEST_PX) return null;
  const across = [(to[1] - from[1]) / length, (from[0] - to[0]) / length];
  const middle = (ends[0] + ends[1]) / 2;
  const [near, end] = [place(middle, false), place(middle, true)];
  const side = across[0] * (near[0] - end[0]) + across[1] * (near[1] - end[1]) < 0 ? -1 : 1;
  return { ends, at, from, to, length, upright, out: across.map((part) => part * side) };
}

// Return where the line from one place to another enters the picture: the place itself if it is inside; null if the line
// stays outside.
function entry(near, end, [left, top, right, bottom]) {
  const [dx, dy] = [end[0] - near[0], end[1] - near[1]];
  let [first, last] = [0, 1];
  for (const [by, room] of [[-dx, near[0] - left], [dx, right - near[0]], [-dy, near[1] - top], [dy, bottom - near[1]]]) {
    if (by === 0 && room < 0) return null;
    if (by < 0) first = Math.max(first, room / by);
    if (by > 0) last = Math.min(last, room / by);
  }
  if (first > last) return null;
  return first === 0 ? near : [near[0] + first * dx, near[1] + first * dy];
}

// Return round numbers along a row: as many as fit, of which one may be left out, as at a corner; two if ever possible.
function fittingNumbers(row, axis, ends, gaps, sheet, measure, taken) {
  const valueAt = (share) => ends[0] + share * (ends[1] - ends[0]);
  const [low, high] = row.ends.map(valueAt).sort((one, other) => one - other);
  const most = Math.max(2, Math.floor(row.length / TICK_PX[Number(row.upright)]));
  const fewer = Array.from({ length: most - 1 }, (_, k) => most - k);
  const more = Array.from({ length: 8 }, (_, k) => most + 1 + k); // round numbers may be far from both ends
  let best = [];
  for (const count of [...fewer, ...more]) {
    const values = ticks(low, high, count);
    const numbers = [];
    for (const value of values) {
      const from = row.at((value - ends[0]) / (ends[1] - ends[0]));
      const number = from && freeNumber(text(value), from, row.out, gaps, sheet, measure, [...taken, ...numbers.map((each) => each.box)]);
      if (number) numbers.push({ ...number, axis, value });
    }
    if (numbers.length > 1 && numbers.length >= values.length - 1) return numbers;
    if (numbers.length > best.length) best = numbers;
  }
  return best;
}

// Return a number at the first free one of its distances from its place; null if all are taken.
function freeNumber(words, from, out, gaps, sheet, measure, taken) {
  const [w, h] = measure(words);
  for (const gap of gaps) {
    const label = labelAt(words, [0, 1].map((k) => from[k] + out[k] * (gap * h + GAP_PX + [w, h][k] / 2)), [w, h], sheet);
    if (isFree(label.box, taken)) return { ...label, from, out, mark: gap * h + 4 };
  }
  return null;
}

// Return the title of an axis, beyond its numbers and near their middle where possible; null if there is no place.
function titleOf(row, words, axis, sheet, measure, taken) {
  const [w, h] = row.upright ? measure(words).reverse() : measure(words);
  const [numberWide, numberTall] = measure('0000');
  const [first, last] = [row.from, row.to];
  const reach = (wide, tall) => (Math.abs(row.out[0]) * wide + Math.abs(row.out[1]) * tall) / 2;
  const beyond = 2 * GAP_PX + 2 * reach(numberWide, numberTall) + reach(w, h);
  for (const gap of [beyond, beyond + h / 2, beyond + h, 0, -beyond]) for (const share of [0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8]) {
    const middle = [0, 1].map((k) => first[k] + share * (last[k] - first[k]) + gap * row.out[k]);
    const label = labelAt(words, middle, [w, h], sheet);
    if (!isFree(label.box, taken)) continue;
    taken.push(label.box);
    return { ...label, axis, title: true, turned: row.upright };
  }
  return null;
}

// Return a label of the given size with its middle at a place, moved into the picture.
function labelAt(words, [x, y], [w, h], [left, top, right, bottom]) {
  const middle = [
    Math.max(left + w / 2 + 2, Math.min(right - w / 2 - 2, x)), Math.max(top + h / 2 + 1, Math.min(bottom - h / 2 - 1, y)),
  ];
  const box = [middle[0] - w / 2 - 2, middle[1] - h / 2 - 1, middle[0] + w / 2 + 2, middle[1] + h / 2 + 1];
  return { text: words, middle, box };
}

function isFree(box, taken) {
  return !taken.some((other) => box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3]);
}

function write(context, label, paper) {
  if (label.from) {
    context.beginPath();
    context.moveTo(...label.from);
    context.lineTo(label.from[0] + label.mark * label.out[0], label.from[1] + label.mark * label.out[1]);
    context.stroke();
  }
  context.save();
  context.translate(...label.middle);
  if (label.turned) context.rotate(-Math.PI / 2);
  context.textAlign = 'center';
  context.textBaseline = 'middle';
  context.lineJoin = 'round';
  context.lineWidth = 5;
  context.strokeStyle = paper; // points do not cover texts
  context.strokeText(label.text, 0, 0);
  context.fillText(label.text, 0, 0);
  context.restore();
}
