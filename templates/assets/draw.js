// Draws a scene with WebGL: one light, plain colours.

import { perspective, unit } from './matrix.js';

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
  #program;
  #places = {};
  #buffers = new WeakMap();

  /** Prepares a canvas. Throws if this browser has no WebGL. */
  constructor(canvas) {
    this.#canvas = canvas;
    this.#gl = canvas.getContext('webgl', { antialias: true, alpha: false });
    if (!this.#gl)
      throw new Error('this browser offers no WebGL, so that nothing can be drawn');
    this.#begin();
    canvas.addEventListener('webglcontextlost', (event) => event.preventDefault());
    canvas.addEventListener('webglcontextrestored', () => this.#begin());
  }

  #begin() {
    const gl = this.#gl;
    this.#buffers = new WeakMap();
    this.#program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(this.#program, shader);
    }
    gl.linkProgram(this.#program);
    gl.useProgram(this.#program);
    const names = ['model', 'view', 'projection', 'colour', 'glow', 'sky', 'toLight', 'lightColour', 'eye', 'opacity', 'haze'];
    for (const name of names)
      this.#places[name] = gl.getUniformLocation(this.#program, name);
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  #buffersOf(mesh) {
    if (!this.#buffers.has(mesh)) {
      const gl = this.#gl;
      const make = (data) => {
        const buffer = gl.createBuffer();
        gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
        gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
        return buffer;
      };
      this.#buffers.set(mesh, [make(mesh.positions), make(mesh.normals)]);
    }
    return this.#buffers.get(mesh);
  }

  /** Draws a scene as a camera sees it. */
  draw(scene, camera) {
    const [gl, at, canvas] = [this.#gl, this.#places, this.#canvas];
    const density = Math.min(2, window.devicePixelRatio || 1);
    const size = [Math.round(canvas.clientWidth * density), Math.round(canvas.clientHeight * density)];
    if (canvas.width !== size[0] || canvas.height !== size[1])
      [canvas.width, canvas.height] = size;
    const aspect = size[0] / Math.max(1, size[1]);
    // Webots' field of view is that of the wider side.
    const angle = aspect > 1 ? 2 * Math.atan(Math.tan(scene.viewpoint.angle / 2) / aspect) : scene.viewpoint.angle;
    gl.viewport(0, 0, ...size);
    gl.clearColor(...scene.sky, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(at.view, false, camera.matrix());
    gl.uniformMatrix4fv(at.projection, false, perspective(angle, aspect, camera.distance / 100, camera.distance * 100));
    gl.uniform3fv(at.sky, scene.sky);
    gl.uniform3fv(at.toLight, unit(scene.light.direction.map((part) => -part)));
    gl.uniform3fv(at.lightColour, scene.light.colour);
    gl.uniform3fv(at.eye, camera.eye);
    gl.uniform1f(at.haze, 4 * camera.distance);
    const clear = scene.shapes.filter(({ opacity }) => opacity < 1);
    for (const shape of scene.shapes.filter(({ opacity }) => opacity >= 1))
      this.#shape(shape);
    gl.enable(gl.BLEND);
    clear.forEach((shape) => this.#shape(shape));
    gl.disable(gl.BLEND);
  }

  #shape({ mesh, matrix, colour, glow, opacity }) {
    const [gl, at] = [this.#gl, this.#places];
    this.#buffersOf(mesh).forEach((buffer, index) => {
      const place = gl.getAttribLocation(this.#program, ['position', 'normal'][index]);
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
