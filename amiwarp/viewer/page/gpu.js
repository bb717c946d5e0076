// Drawing of points by a graphics card, with WebGL 2: what Raster draws, for a million points.

import { FADE } from './raster.js';

const VERTEX = `#version 300 es
uniform vec3 right, up, away, paper;
uniform vec4 centre; // x, y, scale [px], strength of the perspective
uniform vec4 picture; // width, height [px], diameter of a point [px], reach of the box
uniform float fade, opacity;
uniform vec2 slice;
in vec3 place;
in vec4 colour;
out vec4 shade;
void main() {
  float depth = dot(away, place);
  float scale = centre.z / (1.0 - centre.w * depth);
  float low = floor((picture.z - 1.0) / 2.0);
  vec2 corner = floor(vec2(centre.x + scale * dot(right, place), centre.y - scale * dot(up, place)) + 0.5) - low;
  vec2 at = 2.0 * (corner + 0.5 * picture.z) / picture.xy - 1.0;
  bool known = abs(depth) < 1e9 && place.z >= slice.x && place.z <= slice.y;
  gl_Position = known ? vec4(at.x, -at.y, -0.99 * depth / picture.w, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
  gl_PointSize = picture.z;
  shade = vec4(mix(colour.rgb, paper, fade * (0.5 - 0.5 * depth / picture.w)), opacity);
}`;
const FRAGMENT = `#version 300 es
precision mediump float;
in vec4 shade;
out vec4 pixel;
void main() {
  vec2 off = 2.0 * gl_PointCoord - 1.0;
  if (dot(off, off) > 1.0) discard;
  pixel = shade;
}`;
const UNIFORMS = ['right', 'up', 'away', 'paper', 'centre', 'picture', 'fade', 'opacity', 'slice'];

const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i; // renderers slower than Raster

export class GpuRaster {
  // Raises an error if the browser has no WebGL 2, or draws it by software.
  constructor() {
    this.canvas = document.createElement('canvas');
    const gl = this.gl = this.canvas.getContext('webgl2', {
      alpha: false, antialias: false, failIfMajorPerformanceCaveat: true, preserveDrawingBuffer: true,
    });
    const name = gl && gl.getExtension('WEBGL_debug_renderer_info');
    if (!gl || (name && SOFTWARE.test(gl.getParameter(name.UNMASKED_RENDERER_WEBGL)))) {
      throw new Error('no WebGL 2 by a graphics card');
    }
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    ['place', 'colour'].forEach((name, k) => gl.bindAttribLocation(program, k, name));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.at = Object.fromEntries(UNIFORMS.map((name) => [name, gl.getUniformLocation(program, name)]));
    this.buffers = new Map(); // by number of the cloud in the picture and kind
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  get lost() {
    return this.gl.isContextLost();
  }

  begin(width, height, colour) {
    const { gl, canvas } = this;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    this.paper = parts(colour);
    this.clouds = 0;
    gl.viewport(0, 0, width, height);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(...this.paper, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  // Draw points as Raster does. Those at the border of `clip` are drawn in part.
  points(places, colours, projection, size, opacity, clip, fixed = 0) {
    const { gl, at } = this;
    const { away, right, up, depth, scale, x, y, reach, along, low, high } = projection;
    const [x0, y0, x1, y1] = clip;
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(x0, this.canvas.height - y1, Math.max(0, x1 - x0), Math.max(0, y1 - y0));
    for (const [name, value] of Object.entries({ right, up, away, paper: this.paper })) gl.uniform3fv(at[name], value);
    gl.uniform2f(at.slice, low, high);
    gl.uniform4f(at.centre, x, y, scale, depth);
    gl.uniform4f(at.picture, this.canvas.width, this.canvas.height, size, reach);
    gl.uniform1f(at.fade, along ? 0 : FADE);
    gl.uniform1f(at.opacity, opacity);
    this.attribute(0, `${this.clouds} places`, places, [3, gl.FLOAT, false]);
    if (fixed) {
      gl.disableVertexAttribArray(1);
      gl.vertexAttrib4f(1, ...parts(fixed), 1);
    } else {
      this.attribute(1, `${this.clouds} colours`, colours, [4, gl.UNSIGNED_BYTE, true]);
    }
    (opacity < 1 ? gl.enable : gl.disable).call(gl, gl.BLEND);
    (opacity < 1 ? gl.disable : gl.enable).call(gl, gl.DEPTH_TEST);
    gl.drawArrays(gl.POINTS, 0, Math.min(places.length / 3, fixed ? Infinity : colours.length));
    this.clouds += 1;
  }

  // Give an attribute the values of an array, which is copied to the card when it is new.
  attribute(number, name, values, kind) {
    const { gl, buffers } = this;
    const known = buffers.get(name) || { buffer: gl.createBuffer() };
    gl.bindBuffer(gl.ARRAY_BUFFER, known.buffer);
    if (known.values !== values) {
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
      buffers.set(name, { ...known, values });
    }
    gl.enableVertexAttribArray(number);
    gl.vertexAttribPointer(number, ...kind, 0, 0);
  }

  show(context, left, top) {
    context.drawImage(this.canvas, left, top);
  }
}

// Return red, green and blue of a pixel, 0 to 1.
function parts(pixel) {
  return [0, 8, 16].map((shift) => ((pixel >>> shift) & 0xff) / 255);
}
