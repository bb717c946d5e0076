// Camera that turns around a box: turntable angles, zoom and a shift on the screen. Both clouds share one camera.

export const VIEWS = {
  free: [Math.atan2(-1.35, 1), 0.42], 'x-y': [-Math.PI / 2, Math.PI / 2], 'x-θ': [-Math.PI / 2, 0], 'y-θ': [Math.PI, 0],
};
const PERSPECTIVE = 0.22; // strength of the perspective; views along an axis are parallel
export const MARGIN = { left: 66, right: 34, top: 30, bottom: 46 }; // space for labels [px]

export class Camera {
  constructor(view) {
    this.look(view);
  }

  look(view) {
    const [azimuth, elevation] = VIEWS[view] || VIEWS.free;
    Object.assign(this, { azimuth, elevation, zoom: 1, right: 0, up: 0 });
  }

  turn(dx, dy) {
    this.azimuth -= 0.008 * dx;
    this.elevation = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, this.elevation + 0.008 * dy));
  }

  move(dx, dy) {
    this.right += dx;
    this.up += dy;
  }

  // Zoom by a factor; the place (x, y) [px from the centre of the picture] stays where it is.
  scale(factor, x = 0, y = 0) {
    const zoom = Math.max(0.2, Math.min(60, this.zoom * factor));
    const real = zoom / this.zoom;
    this.right = x - real * (x - this.right);
    this.up = y - real * (y - this.up);
    this.zoom = zoom;
  }

  // Return the projection of a box with the given half sizes onto a picture of width x height [px].
  project(half, width, height) {
    const free = [width - MARGIN.left - MARGIN.right, height - MARGIN.top - MARGIN.bottom];
    const [ca, sa, ce, se] = [this.azimuth, this.elevation].flatMap((a) => [Math.cos(a), Math.sin(a)]);
    const away = [ce * ca, ce * sa, se];
    const right = [-sa, ca, 0];
    const up = [-se * ca, -se * sa, ce];
    const along = away.some((part) => Math.abs(part) > 0.9999);
    const reach = Math.hypot(...half);
    const depth = along ? 0 : PERSPECTIVE / reach;
    let [wide, tall] = [1e-6, 1e-6];
    for (const corner of corners([half.map((each) => -each), half])) {
      const w = 1 - depth * dot(away, corner);
      wide = Math.max(wide, Math.abs(dot(right, corner)) / w);
      tall = Math.max(tall, Math.abs(dot(up, corner)) / w);
    }
    const scale = this.zoom * Math.max(1e-3, Math.min(free[0] / (2 * wide), free[1] / (2 * tall)));
    const x = MARGIN.left + free[0] / 2 + this.right;
    const y = MARGIN.top + free[1] / 2 + this.up;
    return {
      away, right, up, depth, reach, scale, x, y, along, free, shift: [this.right, this.up],
      at(point) {
        const w = 1 - depth * dot(away, point);
        return [x + (scale * dot(right, point)) / w, y - (scale * dot(up, point)) / w, dot(away, point)];
      },
    };
  }
}

// Return the place in the box that is seen in the middle of the picture, in the plane through the middle of the box.
export function seenMiddle({ right, up, scale, shift }) {
  return [0, 1, 2].map((k) => (up[k] * shift[1] - right[k] * shift[0]) / scale);
}

// Return the corners [low, high] of the part of a box that gets a frame. In a view along an axis it is the part that is
// seen, so that numbers are next to it at every zoom; else it is all of the box, whose points are seen in depth.
export function seenPart(half, projection) {
  const { right, up, along, free, scale } = projection;
  if (!along) return [half.map((each) => -each), [...half]];
  const reach = [0, 1, 2].map((k) => {
    const wide = Math.abs(right[k]) > 0.5 ? free[0] : Math.abs(up[k]) > 0.5 ? free[1] : Infinity;
    return wide / (2 * scale);
  });
  const middle = seenMiddle(projection);
  const low = middle.map((at, k) => Math.max(-half[k], Math.min(at - reach[k], half[k] - 1e-3)));
  return [low, middle.map((at, k) => Math.min(half[k], Math.max(at + reach[k], low[k] + 1e-3)))];
}

export function corners([low, high]) {
  const out = [];
  for (const x of [low[0], high[0]]) for (const y of [low[1], high[1]]) for (const z of [low[2], high[2]]) out.push([x, y, z]);
  return out;
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
