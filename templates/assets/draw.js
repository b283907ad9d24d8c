// Draws a scene with WebGL: one light, plain colours.

import { perspective, unit } from './matrix.js';
import { SceneError } from './scene.js';

/** @typedef {import('./shapes.js').Triangles} Triangles */

const VERTEX = `
attribute vec3 position;
attribute vec3 normal;
uniform mat4 model, view, projection;
varying vec3 facing;
varying vec3 place;
void main() {
  vec4 world = model * vec4(position, 1.0);
  place = world.xyz;
  facing = mat3(model) * normal;
  gl_Position = projection * view * world;
}`;

const FRAGMENT = `
precision highp float;
uniform vec3 colour, glow, sky, toLight, lightColour, eye;
uniform float opacity, haze;
varying vec3 facing;
varying vec3 place;
void main() {
  vec3 n = normalize(facing);
  vec3 toEye = normalize(eye - place);
  if (dot(n, toEye) < 0.0)
    n = -n;
  vec3 base = pow(colour, vec3(2.2));
  vec3 around = mix(vec3(0.34), vec3(0.52) + 0.1 * sky, 0.5 + 0.5 * n.z);
  float direct = max(dot(n, toLight), 0.0);
  float shine = pow(max(dot(n, normalize(toLight + toEye)), 0.0), 40.0) * 0.12;
  vec3 lit = base * (around + 0.62 * direct * lightColour) + shine * direct + pow(glow, vec3(2.2));
  vec3 far = pow(sky, vec3(2.2));
  float lost = smoothstep(haze, 4.0 * haze, distance(eye, place));
  gl_FragColor = vec4(pow(mix(lit, far, lost), vec3(1.0 / 2.2)), opacity);
}`;

export class Drawing {
  #canvas;
  #gl;
  #locations;
  /** The buffers of each mesh: positions, normals. @type {WeakMap<Triangles, WebGLBuffer[]>} */
  #buffers = new WeakMap();

  /**
   * Prepares a canvas. Throws if this browser has no WebGL.
   * @param {HTMLCanvasElement} canvas
   */
  constructor(canvas) {
    this.#canvas = canvas;
    const gl = canvas.getContext('webgl', { antialias: true, alpha: false });
    if (!gl) {
      throw new SceneError('no-webgl');
    }
    this.#gl = gl;
    this.#locations = this.#begin();
    canvas.addEventListener('webglcontextlost', (event) => event.preventDefault());
    canvas.addEventListener('webglcontextrestored', () => {
      this.#locations = this.#begin();
    });
  }

  #begin() {
    const gl = this.#gl;
    this.#buffers = new WeakMap();
    const program = gl.createProgram();
    for (const { kind, source } of [
      { kind: gl.VERTEX_SHADER, source: VERTEX },
      { kind: gl.FRAGMENT_SHADER, source: FRAGMENT },
    ]) {
      const shader = gl.createShader(kind);
      // A browser that loses its GPU now restores the context later.
      if (!shader) {
        continue;
      }
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    /** @param {string} name */
    const at = (name) => gl.getUniformLocation(program, name);
    return {
      attributes: ['position', 'normal'].map((name) => gl.getAttribLocation(program, name)),
      model: at('model'),
      view: at('view'),
      projection: at('projection'),
      colour: at('colour'),
      glow: at('glow'),
      sky: at('sky'),
      toLight: at('toLight'),
      lightColour: at('lightColour'),
      eye: at('eye'),
      opacity: at('opacity'),
      haze: at('haze'),
    };
  }

  /** @param {Triangles} mesh */
  #buffersOf(mesh) {
    let buffers = this.#buffers.get(mesh);
    if (!buffers) {
      const gl = this.#gl;
      /** @param {Float32Array} data */
      const make = (data) => {
        const buffer = gl.createBuffer();
        gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
        gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
        return buffer;
      };
      buffers = [make(mesh.positions), make(mesh.normals)];
      this.#buffers.set(mesh, buffers);
    }
    return buffers;
  }

  /**
   * Draws a scene as a camera sees it.
   * @param {import('./scene.js').Scene} scene
   * @param {import('./camera.js').Camera} camera
   */
  draw(scene, camera) {
    const gl = this.#gl;
    const at = this.#locations;
    const canvas = this.#canvas;
    const density = Math.min(2, window.devicePixelRatio || 1);
    const width = Math.round(canvas.clientWidth * density);
    const height = Math.round(canvas.clientHeight * density);
    if (canvas.width !== width || canvas.height !== height) {
      [canvas.width, canvas.height] = [width, height];
    }
    const aspect = width / Math.max(1, height);
    // Webots' field of view is that of the wider side.
    const angle = aspect > 1 ? 2 * Math.atan(Math.tan(scene.viewpoint.angle / 2) / aspect) : scene.viewpoint.angle;
    gl.viewport(0, 0, width, height);
    const [red = 0, green = 0, blue = 0] = scene.sky;
    gl.clearColor(red, green, blue, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(at.view, false, camera.matrix());
    gl.uniformMatrix4fv(at.projection, false, perspective(angle, aspect, camera.distance / 100, camera.distance * 100));
    gl.uniform3fv(at.sky, scene.sky);
    gl.uniform3fv(at.toLight, unit(scene.light.direction.map((part) => -part)));
    gl.uniform3fv(at.lightColour, scene.light.colour);
    gl.uniform3fv(at.eye, camera.eye);
    gl.uniform1f(at.haze, 4 * camera.distance);
    const clear = scene.shapes.filter(({ opacity }) => opacity < 1);
    for (const shape of scene.shapes.filter(({ opacity }) => opacity >= 1)) {
      this.#shape(shape);
    }
    gl.enable(gl.BLEND);
    clear.forEach((shape) => this.#shape(shape));
    gl.disable(gl.BLEND);
  }

  /** @param {import('./scene.js').Shape} shape */
  #shape({ mesh, matrix, colour, glow, opacity }) {
    const gl = this.#gl;
    const at = this.#locations;
    this.#buffersOf(mesh).forEach((buffer, index) => {
      const place = at.attributes[index];
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
    });
    gl.uniformMatrix4fv(at.model, false, matrix);
    gl.uniform3fv(at.colour, colour);
    gl.uniform3fv(at.glow, glow);
    gl.uniform1f(at.opacity, opacity);
    gl.drawArrays(gl.TRIANGLES, 0, mesh.positions.length / 3);
  }
}
