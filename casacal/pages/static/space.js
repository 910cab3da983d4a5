// The arm in its cell in space: rods, faces, boxes, table, the touch and the way to it. Millimetres, z upwards.
import * as THREE from "/static/three.module.min.js";

const COLOURS = { arm: 0x7fa6c9, wrist: 0x4f81ad, tip: 0xc2560c, face: 0xd9a441, box: 0xb05c5c, table: 0x8a93a0 };
const APPROACH = 60; // mm of the way to a touch that is drawn
const UP = new THREE.Vector3(0, 1, 0);

export class Space {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(0xdfe7ee);
    this.camera = new THREE.PerspectiveCamera(40, 1, 10, 100000);
    this.camera.up.set(0, 0, 1);
    const sun = new THREE.DirectionalLight(0xffffff, 2);
    sun.position.set(1, -2, 3);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x99a0a8, 1.6), sun);
    this.cell = new THREE.Group();
    this.arm = new THREE.Group();
    this.scene.add(this.cell, this.arm);
    this.turn = -0.9;
    this.tilt = 0.45;
    this.far = 3000;
    this.centre = new THREE.Vector3(0, 0, 300);
    this.listen();
  }

  show(space) {
    this.space = space;
    this.cell.clear();
    const reach = space.reach;
    this.far = 2.2 * reach;
    this.centre.set(0.2 * reach, 0, 0.3 * reach);
    if (space.table !== null) {
      const table = new THREE.Mesh(new THREE.CircleGeometry(1.3 * reach, 48), paint(COLOURS.table, 0.55));
      table.position.z = space.table - 1;
      this.cell.add(table);
    }
    for (const solid of space.solids) {
      const colour = solid.touched ? COLOURS.face : COLOURS.box;
      const shape = new THREE.Mesh(new THREE.BoxGeometry(...solid.size), paint(colour, 0.75));
      const [x, y, z] = solid.axes.map((axis) => new THREE.Vector3(...axis));
      shape.applyMatrix4(new THREE.Matrix4().makeBasis(x, y, z).setPosition(...solid.centre));
      this.cell.add(shape);
    }
  }

  map(parts) {
    for (const { colour, places } of parts) {
      const shape = new THREE.BufferGeometry().setFromPoints(places.map((place) => new THREE.Vector3(...place)));
      this.cell.add(new THREE.Points(shape, new THREE.PointsMaterial({ color: colour, size: this.space.reach / 32 })));
    }
  }

  pose(arm) {
    this.arm.clear();
    const nodes = arm.nodes.map((node) => new THREE.Vector3(...node));
    const radii = this.space.radii;
    for (let k = 0; k + 1 < nodes.length; k++) {
      this.arm.add(...rod(nodes[k], nodes[k + 1], radii[k], radii[k] < radii[0] ? COLOURS.wrist : COLOURS.arm));
    }
    const tip = nodes.at(-1), dot = new THREE.Mesh(new THREE.SphereGeometry(8, 16, 12), paint(COLOURS.tip));
    dot.position.copy(tip);
    this.arm.add(dot);
    if (arm.plunger) {
      const along = new THREE.Vector3(...arm.plunger), from = tip.clone().addScaledVector(along, -APPROACH);
      this.arm.add(new THREE.ArrowHelper(along, from, APPROACH, COLOURS.tip, 22, 14));
    }
    this.draw();
  }

  draw() {
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    const flat = Math.cos(this.tilt);
    const way = new THREE.Vector3(flat * Math.cos(this.turn), flat * Math.sin(this.turn), Math.sin(this.tilt));
    this.camera.position.copy(this.centre).addScaledVector(way, this.far);
    this.camera.lookAt(this.centre);
    this.renderer.render(this.scene, this.camera);
  }

  move(turn, tilt, nearer) {
    this.turn -= turn;
    this.tilt = Math.min(Math.max(this.tilt + tilt, -0.2), 1.5);
    this.far = Math.min(Math.max(this.far * nearer, 200), 30000);
    this.draw();
  }

  listen() {
    const fingers = new Map();
    const apart = () => {
      const [a, b] = [...fingers.values()];
      return Math.hypot(a.x - b.x, a.y - b.y);
    };
    this.canvas.addEventListener("pointerdown", (event) => {
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const wide = fingers.size === 2 ? apart() : 0;
      const across = event.clientX - before.x, down = event.clientY - before.y;
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      if (wide) this.move(0, 0, wide / Math.max(apart(), 1));
      else this.move(across / 150, down / 150, 1);
    });
    for (const over of ["pointerup", "pointercancel"]) {
      this.canvas.addEventListener(over, (event) => fingers.delete(event.pointerId));
    }
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.move(0, 0, Math.exp(event.deltaY / 800));
    }, { passive: false });
    this.canvas.addEventListener("keydown", (event) => {
      if (!(event.key in KEYS)) return;
      event.preventDefault();
      this.move(...KEYS[event.key]);
    });
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }
}

const KEYS = {
  ArrowLeft: [0.15, 0, 1], ArrowRight: [-0.15, 0, 1], ArrowUp: [0, 0.1, 1], ArrowDown: [0, -0.1, 1],
  "+": [0, 0, 0.85], "-": [0, 0, 1.18],
};

function paint(color, opacity = 1) {
  return new THREE.MeshLambertMaterial({ color, opacity, transparent: opacity < 1, side: THREE.DoubleSide });
}

function rod(from, to, radius, colour) {
  const along = to.clone().sub(from), length = along.length();
  const end = new THREE.Mesh(new THREE.SphereGeometry(radius, 20, 14), paint(colour));
  end.position.copy(from);
  if (length < 1) return [end];
  const body = new THREE.Mesh(new THREE.CylinderGeometry(radius, radius, length, 20), paint(colour));
  body.position.copy(from).addScaledVector(along, 0.5);
  body.quaternion.setFromUnitVectors(UP, along.normalize());
  return [end, body];
}
