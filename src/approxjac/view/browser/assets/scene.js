"use strict";
// The 3-D scene: MeshCat's viewer, and what moves in it.
// Positions are in the robot's world (z up); three.js has y up: (x, y, z) there is (x, z, −y) here.
const approxjac = window.approxjac = {};

// Colours of the page as they are now, light or dark.
approxjac.theme = () => {
  const style = getComputedStyle(document.documentElement), dark = approxjac.darkness.matches;
  const names = ["ink", "soft", "line", "faint", "paper", "black"];
  return { dark, ...Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()])) };
};
approxjac.darkness = matchMedia("(prefers-color-scheme: dark)");
// Black stands out from all other colours; on a dark page that is white.
approxjac.shown = (colour, theme = approxjac.theme()) => (colour === "#000000" ? theme.black : colour);

approxjac.Scene = class {
  constructor(data, element) {
    this.data = data;
    this.element = element;
    this.viewer = new MeshCat.Viewer(element);
    this.viewer.gui.domElement.remove();
    this.joints = {}; // by role, as all that may be built anew
    this.images = {};
    this.trails = {};
    this.touched = false; // whether the user has turned the view
    this._quiet();
    this.build(data);
    data.walls.forEach((wall, k) => this._wall(wall, k));
    this.paint();
    // MeshCat takes the whole window's height; here the viewer has a part of it
    this.viewer.set_3d_pane_size = () => this.resize();
    new ResizeObserver(() => this.resize()).observe(element);
    this.viewer.controls.addEventListener("start", () => { this.touched = true; });
    this.resize();
    if (data.live) this._dragTarget();
  }

  // What has other colours on a dark page.
  paint() {
    const { viewer } = this, theme = approxjac.theme();
    const [top, bottom] = theme.dark ? [[24, 28, 33], [31, 36, 42]] : [[253, 253, 254], [241, 243, 245]];
    viewer.set_property(["Background"], "top_color", top.map((part) => part / 255));
    viewer.set_property(["Background"], "bottom_color", bottom.map((part) => part / 255));
    this.object(["grid"]).traverse((object) => object.material?.color.set(theme.dark ? "#343c45" : "#dde1e6"));
    this.force.node.traverse((object) => {
      object.material?.color.set(approxjac.shown(this.data.colours.force, theme));
    });
    viewer.set_dirty();
  }

  // Soft lights, no axes.
  _quiet() {
    const { viewer } = this;
    viewer.delete_path(["Grid"]);
    viewer.delete_path(["Axes"]);
    const light = (name) => viewer.scene_tree.find(["Lights", name, "<object>"]).object;
    light("AmbientLight").intensity = 0.62;
    light("FillLight").intensity = 0.16;
    for (const name of ["PointLightNegativeX", "PointLightPositiveX"]) {
      light(name).distance = 0; // as bright on large arms as on small ones
      light(name).intensity = name.endsWith("NegativeX") ? 0.26 : 0.14;
      light(name).position.multiplyScalar(2 * this.data.size);
    }
    viewer.camera.fov = 30;
  }

  object(path) { return this.viewer.scene_tree.find(path).object; }

  // Build what `data` describes, in place of what there was of the same roles.
  build(data) {
    const THREE = MeshCat.THREE, { viewer } = this, colours = this.data.colours;
    for (const role of data.roles) {
      for (const root of [role, "camera_" + role, "points_" + role]) viewer.delete_path([root]);
    }
    for (const command of data.commands) {
      viewer.handle_command_bytearray(Uint8Array.from(atob(command), (c) => c.charCodeAt(0)));
    }
    for (const { from, to } of data.clones) { // what looks the same is sent once
      const material = new THREE.MeshLambertMaterial({ color: colours.believed });
      viewer.set_object(to, new THREE.Mesh(this.object([...from, "<object>"]).geometry, material));
    }
    for (const role of data.roles) {
      if (role === "believed") this._ghost();
      else this._markers(data);
      this.joints[role] = this._joints(data.joints[role]);
      this.images[role] = data.cameras.filter((camera) => camera.role === role)
        .map((camera) => this._camera(camera));
    }
    if (data.roles.includes("believed")) { // nothing differs: there is nothing to see
      this.differs = data.differs;
      for (const root of ["believed", "camera_believed", "points_believed"]) {
        if (viewer.scene_tree.children[root]) this.object([root]).visible = data.differs;
      }
    }
    viewer.set_dirty();
  }

  _joints(joints) {
    const found = [];
    for (const joint of joints) {
      this.viewer.set_transform(joint.path, joint.origin);
      if (joint.column < 0) continue;
      const node = this.object(joint.path);
      found.push({
        node, column: joint.column, turns: joint.kind === "revolute",
        axis: new MeshCat.THREE.Vector3(...joint.axis),
        position: node.position.clone(), quaternion: node.quaternion.clone(),
      });
    }
    return found;
  }

  // The believed arm lets the true one through, and is hidden where both are the same.
  _ghost() {
    if (!this.viewer.scene_tree.children.believed) return;
    const THREE = MeshCat.THREE, shapes = [];
    this.object(["believed"]).traverse((object) => {
      if (object.isMesh && object.parent.name.startsWith("bone")) object.renderOrder = 8;
      if (!object.isMesh || !object.parent.name.startsWith("shape")) return;
      Object.assign(object.material, {
        transparent: true, opacity: 0.42, depthWrite: true, side: THREE.FrontSide,
        polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 4,
      });
      object.castShadow = false;
      shapes.push(object);
    });
    // Where both arms are the same, a rim around the true one shows that it is believed there: the
    // believed one a little larger, outside of its own outline, which is stencilled out.
    const stencil = { transparent: true, depthWrite: false, side: THREE.DoubleSide, stencilWrite: true, stencilRef: 1 };
    const mask = new THREE.MeshBasicMaterial({ ...stencil, colorWrite: false, depthTest: false,
      stencilZPass: THREE.ReplaceStencilOp });
    const rim = new THREE.MeshBasicMaterial({ ...stencil, color: this.data.colours.believed,
      stencilFunc: THREE.NotEqualStencilFunc });
    rim.onBeforeCompile = (shader) => {
      shader.vertexShader = shader.vertexShader.replace("#include <begin_vertex>",
        `vec3 transformed = position + normal * ${(0.0032 * this.data.size).toFixed(6)};`);
    };
    for (const shape of shapes) {
      const covered = new THREE.Mesh(shape.geometry, mask);
      const around = new THREE.Mesh(this._closed(shape.geometry), rim);
      covered.renderOrder = 1;
      around.renderOrder = 2;
      shape.add(covered, around);
    }
  }

  // The same shape with one normal at each place: along those it grows without tearing its edges.
  _closed(geometry) {
    this.grown = this.grown || new WeakMap();
    if (this.grown.has(geometry)) return this.grown.get(geometry);
    const THREE = MeshCat.THREE, found = new THREE.BufferGeometry();
    const { position, normal } = geometry.attributes, near = 1e5 / this.data.size, sums = new Map();
    const at = Array.from({ length: position.count }, (_, i) => {
      const place = [position.getX(i), position.getY(i), position.getZ(i)].map((x) => Math.round(near * x)).join();
      if (!sums.has(place)) sums.set(place, new THREE.Vector3());
      return sums.get(place).add(new THREE.Vector3().fromBufferAttribute(normal, i));
    });
    for (const sum of sums.values()) sum.normalize();
    found.setAttribute("position", position);
    found.setAttribute("normal", new THREE.Float32BufferAttribute(at.flatMap((n) => [n.x, n.y, n.z]), 3));
    found.setIndex(geometry.index);
    this.grown.set(geometry, found);
    return found;
  }

  // A square of a wall, about a point of it.
  _wall([centre, normal], k) {
    const THREE = MeshCat.THREE, side = 0.45 * this.data.size, color = this.data.colours.neutral;
    const lines = new THREE.GridHelper(side, 8, color, color), pane = new THREE.Mesh(
      new THREE.PlaneGeometry(side, side).rotateX(-Math.PI / 2), new THREE.MeshBasicMaterial({
        color, opacity: 0.1, transparent: true, depthWrite: false, side: THREE.DoubleSide }));
    lines.material.setValues({ opacity: 0.5, transparent: true });
    for (const [name, part] of Object.entries({ lines, pane })) {
      part.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), new THREE.Vector3(...normal));
      part.position.set(...centre);
      this.viewer.set_object(["wall" + k, name], part);
    }
  }

  // What moves besides the arms, and the links, whose colours change.
  _markers(data) {
    this.links = data.links;
    for (const link of this.links) {
      link.material = this.object([...link.path, "<object>"]).material;
      link.rest = new MeshCat.THREE.Color(link.colour);
    }
    this.markers = {};
    // they are drawn over the arm, in this order
    ["target", "believed_tip", "measured", "tip"].forEach((name, i) => {
      this.markers[name] = this.object([name]);
      this.object([name, "<object>"]).renderOrder = 10 + i;
    });
    this.force = { node: this.object(["force"]), shaft: this.object(["force", "shaft"]),
      head: this.object(["force", "head"]) };
    for (const part of ["shaft", "head"]) this.object(["force", part, "<object>"]).renderOrder = 9;
    for (const node of [this.force.node, ...Object.values(this.markers)]) node.visible = false; // until there are rows
  }

  // What is seen, on a camera's image plane, and the lines of sight of targets.
  _camera(camera) {
    const THREE = MeshCat.THREE, colours = this.data.colours, size = this.data.size;
    const vector = (name) => new THREE.Vector3(...camera[name]);
    const image = { apex: vector("apex"), corner: vector("corner"), right: vector("right"),
      down: vector("down"), low: camera.low, high: camera.high, reach: camera.reach, dots: [], sights: [] };
    const dot = new THREE.SphereGeometry(0.009 * size, 12, 8);
    const line = new THREE.CylinderGeometry(0.0022 * size, 0.0022 * size, 1, 6);
    const path = [...camera.node, "camera_" + camera.role];
    const add = (name, geometry, color, opacity) => {
      const material = new THREE.MeshBasicMaterial({ color, opacity, transparent: opacity < 1 });
      const mesh = new THREE.Mesh(geometry, material);
      this.viewer.set_object([...path, name], mesh);
      return mesh;
    };
    const other = camera.role === "true" ? ["target_pixels", colours.target] : ["believed_pixels", colours.believed];
    for (let k = 0; k < this.data.image.points; k++) {
      for (const [column, color] of [["pixels", colours.true], other]) {
        image.dots.push({ mesh: add(column + k, dot, color, 1), column, k });
      }
      if (camera.role === "true") {
        image.sights.push({ mesh: add("sight" + k, line, colours.target, 0.65), k });
      }
    }
    return image;
  }

  // Everything as it is at instant `s` of `rows`, which may lie between two.
  show(rows, s) {
    const THREE = MeshCat.THREE;
    if (!rows.length) return;
    const q = rows.at("joints", s);
    const turn = new THREE.Quaternion(), step = new THREE.Vector3();
    for (const joint of Object.values(this.joints).flat()) {
      if (joint.turns) {
        joint.node.quaternion.copy(joint.quaternion)
          .multiply(turn.setFromAxisAngle(joint.axis, q[joint.column]));
      } else {
        step.copy(joint.axis).multiplyScalar(q[joint.column]).applyQuaternion(joint.quaternion);
        joint.node.position.copy(joint.position).add(step);
      }
    }
    for (const [name, node] of Object.entries(this.markers)) {
      const p = rows.at(name, s);
      node.visible = p.every(Number.isFinite);
      if (node.visible) node.position.set(...p);
    }
    const { tip, believed_tip: believed } = this.markers;
    if (tip.position.distanceTo(believed.position) < 1e-6 * this.data.size) believed.visible = false;
    this._arrow(rows.at("believed_tip", s), rows.at("force", s), rows.largest("force"));
    this._states(rows.row("load", Math.ceil(s)), rows.row("at_limit", Math.round(s)));
    for (const image of Object.values(this.images).flat()) this._image(image, rows, s);
    this._paths(rows, s);
    this.viewer.set_dirty();
  }

  // The force at the believed tip; the largest of the run is a third of the arm long.
  _arrow(from, force, largest) {
    const { node, shaft, head } = this.force, f = new MeshCat.THREE.Vector3(...force);
    const length = 0.33 * this.data.size * f.length() / (largest || 1);
    const tip = 0.042 * this.data.size;
    node.visible = Number.isFinite(length) && from.every(Number.isFinite) && length > 0.2 * tip;
    if (!node.visible) return;
    node.position.set(...from);
    node.quaternion.setFromUnitVectors(new MeshCat.THREE.Vector3(0, 1, 0), f.normalize());
    const scale = Math.min(1, length / (1.5 * tip)); // a short one has a small head
    head.scale.setScalar(scale);
    head.position.y = length - 0.5 * scale * tip;
    shaft.scale.set(1, Math.max(length - scale * tip, 1e-6), 1);
    shaft.position.y = 0.5 * (length - scale * tip);
  }

  // Links take the colour of the state of the joint that moves them.
  _states(load, atLimit) {
    const THREE = MeshCat.THREE, colours = this.data.colours;
    for (const link of this.links) {
      const share = load[link.driver], color = link.material.color.copy(link.rest);
      if (share >= 0.999) color.set(colours.saturated);
      else if (atLimit[link.driver] >= 1) color.set(colours.at_limit);
      else if (share > 0.8) color.lerp(new THREE.Color(colours.saturated), 2.5 * (share - 0.8));
    }
  }

  _image(image, rows, s) {
    const THREE = MeshCat.THREE;
    const place = (column, k) => { // on the drawn image plane; null off it or where there is none
      const x = rows.at(column, s).slice(2 * k, 2 * k + 2);
      const share = x.map((value, i) => (value - image.low[i]) / (image.high[i] - image.low[i]));
      if (!share.every((value) => value >= 0 && value <= 1)) return null;
      return image.corner.clone().addScaledVector(image.right, share[0]).addScaledVector(image.down, share[1]);
    };
    for (const { mesh, column, k } of image.dots) {
      const p = place(column, k);
      mesh.visible = p !== null;
      if (p) mesh.position.copy(p);
    }
    for (const { mesh, k } of image.sights) {
      const p = place("target_pixels", k);
      mesh.visible = p !== null;
      if (!p) continue;
      const along = p.sub(image.apex).multiplyScalar(image.reach);
      mesh.position.copy(image.apex).addScaledVector(along, 0.5);
      mesh.scale.set(1, along.length(), 1);
      mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), along.normalize());
    }
  }

  // Paths up to now, as thin rods: lines are a pixel wide whatever one asks for. That of what was
  // measured is hidden by the true one where they agree, and has gaps where nothing was measured.
  _paths(rows, s) {
    const { colours } = this.data;
    this._path("measured", colours.measured, 0.0018 * this.data.size, rows, s);
    this._path("tip", colours.true, 0.0028 * this.data.size, rows, s);
  }

  _path(name, color, r, rows, s) {
    const THREE = MeshCat.THREE;
    let trail = this.trails[name];
    if (!trail || rows.length > trail.capacity) {
      const capacity = Math.max(256, 2 * rows.length);
      const mesh = new THREE.InstancedMesh(new THREE.CylinderGeometry(r, r, 1, 6),
        new THREE.MeshBasicMaterial({ color }), capacity);
      mesh.frustumCulled = false;
      this.viewer.set_object(["trail " + name], mesh);
      trail = this.trails[name] = { mesh, capacity, done: 0 };
    }
    const up = new THREE.Vector3(0, 1, 0);
    const draw = (i, to) => { // from row i to a row, or between two
      const a = new THREE.Vector3(...rows.row(name, i));
      const way = new THREE.Vector3(...rows.at(name, to)).sub(a), length = way.length();
      const matrix = new THREE.Matrix4().makeScale(0, 0, 0); // of a gap
      if (Number.isFinite(length)) {
        const middle = a.addScaledVector(way, 0.5);
        const turn = new THREE.Quaternion().setFromUnitVectors(up, length > 0 ? way.normalize() : up);
        matrix.compose(middle, turn, new THREE.Vector3(1, length, 1));
      }
      trail.mesh.setMatrixAt(i, matrix);
      trail.mesh.instanceMatrix.needsUpdate = true;
    };
    if (trail.cut !== undefined) draw(trail.cut, trail.cut + 1); // whole again
    for (; trail.done < rows.length - 1; trail.done++) draw(trail.done, trail.done + 1);
    const full = Math.min(trail.done, Math.floor(s));
    trail.cut = full < trail.done ? full : undefined;
    if (trail.cut !== undefined) draw(trail.cut, s); // up to where the tip is
    trail.mesh.count = trail.cut === undefined ? full : full + 1;
    trail.mesh.visible = trail.mesh.count > 0;
  }

  // -- the view ------------------------------------------------------------------------

  resize() {
    const w = this.element.clientWidth, h = this.element.clientHeight, { viewer } = this;
    if (!w || !h) return;
    viewer.camera.aspect = w / h;
    viewer.renderer.setSize(w, h);
    if (!this.touched) this._frame();
    viewer.camera.updateProjectionMatrix();
    viewer.set_dirty();
  }

  // As at the start, with the arm where it is now.
  reset() {
    this.touched = false;
    this.moved = this.data.live; // who knows where to
    this.resize();
  }

  // Corners around the arm where it is now.
  _now() {
    const THREE = MeshCat.THREE, box = new THREE.Box3().setFromObject(this.object(["true"]));
    if (box.isEmpty() || !this.moved) return [];
    return [0, 1, 2, 3, 4, 5, 6, 7].map((i) => new THREE.Vector3(
      (i & 1 ? box.max : box.min).x, (i & 2 ? box.max : box.min).y, (i & 4 ? box.max : box.min).z));
  }

  // Put the eye as near as it may come in its direction with all points in view.
  _frame() {
    const THREE = MeshCat.THREE, { camera, controls } = this.viewer;
    const inThree = ([x, y, z]) => new THREE.Vector3(x, z, -y);
    const towards = inThree(this.data.view.direction).normalize();
    const right = new THREE.Vector3().crossVectors(camera.up, towards);
    if (right.length() < 1e-6) right.set(1, 0, 0);
    right.normalize();
    const up = new THREE.Vector3().crossVectors(towards, right);
    const slope = 0.92 * Math.tan(0.5 * camera.fov * Math.PI / 180);
    const points = [...this.data.view.points.map(inThree), ...this._now()];
    const depth = points.map((p) => p.dot(towards));
    const fit = (axis, tan) => { // the nearest eye, and where it is across
      const across = points.map((p) => p.dot(axis));
      const high = Math.max(...across.map((a, i) => a + tan * depth[i]));
      const low = Math.min(...across.map((a, i) => a - tan * depth[i]));
      return [(high - low) / (2 * tan), (high + low) / 2];
    };
    const [eyeX, x] = fit(right, slope * camera.aspect), [eyeY, y] = fit(up, slope);
    const eye = Math.max(eyeX, eyeY), middle = 0.5 * (Math.max(...depth) + Math.min(...depth));
    const centre = right.multiplyScalar(x).add(up.multiplyScalar(y));
    controls.target.copy(centre).addScaledVector(towards, middle);
    camera.position.copy(centre).addScaledVector(towards, eye);
    camera.near = 0.02 * this.data.size;
    camera.far = Math.max(100 * this.data.size, 4 * eye);
    controls.update();
  }

  // Where a point of the world is on the page, in CSS pixels.
  project([x, y, z]) {
    const { camera } = this.viewer, box = this.element.getBoundingClientRect();
    camera.updateMatrixWorld();
    const p = new MeshCat.THREE.Vector3(x, z, -y).project(camera);
    return { x: box.left + 0.5 * (1 + p.x) * box.width, y: box.top + 0.5 * (1 - p.y) * box.height };
  }

  // -- dragging the target ---------------------------------------------------------------

  _dragTarget() {
    const THREE = MeshCat.THREE, { viewer, element } = this, target = this.markers.target;
    const ray = new THREE.Raycaster(), plane = new THREE.Plane();
    const aim = (event) => {
      const box = element.getBoundingClientRect();
      ray.setFromCamera({ x: 2 * (event.clientX - box.left) / box.width - 1,
        y: 1 - 2 * (event.clientY - box.top) / box.height }, viewer.camera);
    };
    const hit = (event) => {
      aim(event);
      return target.visible && ray.intersectObject(target, true).length > 0;
    };
    let drags = false;
    // before OrbitControls hears of it, which would turn the view
    element.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || !hit(event)) return;
      drags = true;
      viewer.controls.enabled = false;
      element.setPointerCapture(event.pointerId);
      const facing = viewer.camera.getWorldDirection(new THREE.Vector3());
      plane.setFromNormalAndCoplanarPoint(facing, target.getWorldPosition(new THREE.Vector3()));
      event.stopPropagation();
    }, true);
    element.addEventListener("pointermove", (event) => {
      if (!drags) {
        element.style.cursor = hit(event) ? "grab" : "";
        return;
      }
      aim(event);
      const p = ray.ray.intersectPlane(plane, new THREE.Vector3());
      if (p) approxjac.ontarget?.([p.x, -p.z, p.y]);
    }, true);
    const release = () => { drags = false; viewer.controls.enabled = true; };
    element.addEventListener("pointerup", release, true);
    element.addEventListener("pointercancel", release, true);
  }
};
