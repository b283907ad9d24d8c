// A scene as a simulator sends it: the nodes of its model, and their current poses.

import { identity, pose, times } from './matrix.js';
import { shape } from './shapes.js';

/** @typedef {import('./matrix.js').Matrix} Matrix */

/** What is drawn: a mesh with its looks, and where it is.
 * @typedef {{ mesh: import('./shapes.js').Triangles, colour: number[], glow: number[], opacity: number, matrix: Matrix }} Shape
 */
/** A node that has a pose, with what is below it.
 * @typedef {{ translation: number[], rotation: number[], scale: number[], children: Node[], shapes: Shape[] }} Node
 */
/** @typedef {{ position: number[], orientation: number[], angle?: number }} Viewpoint */

/** Why a scene can't be shown.
 * @typedef {'no-webgl' | 'unreadable' | 'no-frame' | 'not-loaded'} SceneProblem
 */

export class SceneError extends Error {
  /** @param {SceneProblem} code */
  constructor(code) {
    super(code);
    this.code = code;
  }
}

const PLACED = new Set(['Pose', 'Transform', 'Solid', 'Robot']);

/**
 * The numbers in a text; without one, those that are the default.
 * @param {string | null | undefined} text
 * @param {number[]} standard
 */
const numbers = (text, standard) =>
  text
    ? text
        .trim()
        .split(/[\s,]+/)
        .map(Number)
    : standard;

/** @returns {Node} */
const emptyNode = () => ({
  translation: [0, 0, 0],
  rotation: [0, 0, 1, 0],
  scale: [1, 1, 1],
  children: [],
  shapes: [],
});

export class Scene {
  /** @type {Shape[]} */
  shapes = [];
  title = '';
  sky = [0.6, 0.75, 0.9];
  light = { direction: [0.4, 0.3, -1], colour: [1, 1, 1] };
  viewpoint = { position: [-5, 0, 3], orientation: [0, 1, 0, 0.5], angle: Math.PI / 4 };
  /** The nodes by their numbers. @type {Map<number, Node>} */
  #nodes = new Map();
  #root = emptyNode();

  /**
   * Reads a model. Throws if it is not one.
   * @param {string} xml
   */
  constructor(xml) {
    const document = new DOMParser().parseFromString(xml, 'text/xml');
    const scene = document.querySelector('Scene');
    if (!scene || document.querySelector('parsererror')) {
      throw new SceneError('unreadable');
    }
    this.#settings(scene);
    for (const element of scene.children) {
      this.#read(element, this.#root);
    }
    this.place();
  }

  /** @param {Element} scene */
  #settings(scene) {
    this.title = scene.querySelector('WorldInfo')?.getAttribute('title') ?? '';
    this.sky = numbers(scene.querySelector('Background')?.getAttribute('skyColor'), this.sky).slice(0, 3);
    const light = scene.querySelector('DirectionalLight');
    this.light.direction = numbers(light?.getAttribute('direction'), this.light.direction);
    this.light.colour = numbers(light?.getAttribute('color'), this.light.colour);
    const view = scene.querySelector('Viewpoint');
    this.viewpoint.position = numbers(view?.getAttribute('position'), this.viewpoint.position);
    this.viewpoint.orientation = numbers(view?.getAttribute('orientation'), this.viewpoint.orientation);
    this.viewpoint.angle = Number(view?.getAttribute('fieldOfView') ?? this.viewpoint.angle);
  }

  /**
   * @param {Element} element
   * @param {Node} parent
   */
  #read(element, parent) {
    if (element.getAttribute('role') === 'boundingObject') {
      return;
    }
    if (element.tagName === 'Shape') {
      this.#readShape(element, parent);
      return;
    }
    let node = parent;
    if (PLACED.has(element.tagName)) {
      node = {
        translation: numbers(element.getAttribute('translation'), [0, 0, 0]),
        rotation: numbers(element.getAttribute('rotation'), [0, 0, 1, 0]),
        scale: numbers(element.getAttribute('scale'), [1, 1, 1]),
        children: [],
        shapes: [],
      };
      this.#nodes.set(Number(element.id.slice(1)), node);
      parent.children.push(node);
    }
    for (const child of element.children) {
      this.#read(child, node);
    }
  }

  /**
   * @param {Element} element
   * @param {Node} node
   */
  #readShape(element, node) {
    const mesh = [...element.children].map(shape).find((found) => found !== undefined);
    if (!mesh) {
      return;
    }
    const look = element.querySelector('PBRAppearance, Material');
    const colour = look?.getAttribute('baseColor') ?? look?.getAttribute('diffuseColor');
    const drawn = {
      mesh,
      colour: numbers(colour, look ? [1, 1, 1] : [0.8, 0.8, 0.8]),
      glow: numbers(look?.getAttribute('emissiveColor'), [0, 0, 0]),
      opacity: 1 - Number(look?.getAttribute('transparency') ?? 0),
      matrix: identity(),
    };
    node.shapes.push(drawn);
    this.shapes.push(drawn);
  }

  /**
   * Applies an update: poses of nodes by their numbers.
   * @param {Pick<import('./stream.js').Update, 'updates'>} update
   */
  update({ updates = [] }) {
    for (const { id, translation, rotation } of updates) {
      const node = this.#nodes.get(id);
      if (!node) {
        continue;
      }
      node.translation = numbers(translation, node.translation);
      node.rotation = numbers(rotation, node.rotation);
    }
    this.place();
  }

  /**
   * Computes where each shape is.
   * @param {Node} node
   * @param {Matrix} matrix
   */
  place(node = this.#root, matrix = identity()) {
    for (const drawn of node.shapes) {
      drawn.matrix = matrix;
    }
    for (const child of node.children) {
      this.place(child, times(matrix, pose(child.translation, child.rotation, child.scale)));
    }
  }
}
