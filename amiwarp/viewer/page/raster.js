// Drawing of points into a picture by the processor. It needs no graphics card: on machines with software rendering it
// is many times faster than WebGL, and it draws the same picture everywhere.

export const FADE = 0.45; // share of the background in the colour of the farthest point, if the clouds are seen in depth

export class Raster {
  // Begin an empty picture of this size [px].
  begin(width, height, colour) {
    if (this.image?.width !== width || this.image.height !== height) {
      this.image = new ImageData(width, height);
      this.pixels = new Uint32Array(this.image.data.buffer);
      this.depth = new Float32Array(width * height);
    }
    this.paper = colour;
    this.pixels.fill(colour);
    this.depth.fill(-Infinity);
  }

  // Draw n points (x, y, z interleaved, NaN for none); the nearest point covers the others. With an opacity below 1,
  // points are mixed in their order. `fixed` is one colour for all points. Points that leave `clip` (left, top, right,
  // bottom) or the slice of the projection are not drawn.
  points(places, colours, projection, size, opacity, clip, fixed = 0) {
    const { pixels, depth, image } = this;
    const [x0, y0, x1, y1] = [Math.max(clip[0], 0), Math.max(clip[1], 0), Math.min(clip[2], image.width), Math.min(clip[3], image.height)];
    const { away, right, up, depth: near, scale, x: cx, y: cy, reach, along, low: z0, high: z1 } = projection;
    const [W, n, low] = [image.width, places.length / 3, Math.floor((size - 1) / 2)];
    const [r0, r1, u0, u1, u2, a0, a1, a2] = [...right.slice(0, 2), ...up, ...away];
    const mix = Math.round(256 * opacity);
    const fade = along ? 0 : 128 * FADE / reach; // by distance from the nearest corner
    const ends = Array.from({ length: size }, (_, row) => {
      const off = (2 * row + 1) / size - 1;
      return Math.round((size * (1 + Math.sqrt(1 - off * off))) / 2);
    }); // of the rows of a point
    for (let i = 0, j = 0; i < n; i++, j += 3) {
      const x = places[j], y = places[j + 1], z = places[j + 2];
      if (!(z >= z0 && z <= z1)) continue;
      const d = a0 * x + a1 * y + a2 * z;
      const s = scale / (1 - near * d);
      const left = Math.round(cx + s * (r0 * x + r1 * y)) - low;
      const top = Math.round(cy - s * (u0 * x + u1 * y + u2 * z)) - low;
      if (!(left >= x0 && top >= y0 && left + size <= x1 && top + size <= y1)) continue;
      const colour = mixed(fixed || colours[i], this.paper, (fade * (reach - d)) | 0);
      for (let row = top * W + left, k = 0; k < size; row += W, k++) {
        for (let at = row + size - ends[k]; at < row + ends[k]; at++) {
          if (mix < 256) {
            pixels[at] = mixed(pixels[at], colour, mix);
          } else if (d > depth[at]) {
            depth[at] = d;
            pixels[at] = colour;
          }
        }
      }
    }
  }

  show(context, left, top) {
    context.putImageData(this.image, left, top);
  }
}

function mixed(below, above, share) {
  const rest = 256 - share;
  const even = (((below & 0xff00ff) * rest + (above & 0xff00ff) * share) >>> 8) & 0xff00ff;
  const green = (((below & 0xff00) * rest + (above & 0xff00) * share) >>> 8) & 0xff00;
  return (0xff000000 | even | green) >>> 0;
}

// Return the index of the point that is drawn nearest to (x, y) [px], or -1 if none is within `reach` [px].
export function nearest(places, projection, x, y, reach) {
  let [best, least, front] = [-1, reach, -Infinity];
  for (let i = 0; i < places.length / 3; i++) {
    if (!(places[3 * i + 2] >= projection.low && places[3 * i + 2] <= projection.high)) continue;
    const [px, py, d] = projection.at([places[3 * i], places[3 * i + 1], places[3 * i + 2]]);
    const distance = Math.hypot(px - x, py - y);
    if (distance < least - 2 || (distance < least + 2 && distance <= reach && d > front)) {
      [best, least, front] = [i, Math.min(distance, least), d];
    }
  }
  return best;
}
