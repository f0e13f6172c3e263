"use strict";
(() => {
  const view = document.getElementById("view");
  const data = JSON.parse(document.getElementById("view-data").textContent);
  const canvas = view.querySelector("canvas"), slider = view.querySelector("input");
  // What was drawn stays, so that it is printed too.
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) { canvas.hidden = true; view.querySelector("p").hidden = false; return; }

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const arrays = (x, faces) => ({
    points: new Float32Array(bytes(x.points)),
    faces: x.faces === undefined ? faces : new Uint32Array(bytes(x.faces)),
  });
  const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
  const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((x) => x / n); };

  const shader = (kind, text) => {
    const made = gl.createShader(kind);
    gl.shaderSource(made, "#version 300 es\nprecision highp float;\n" + text);
    gl.compileShader(made);
    gl.attachShader(program, made);
  };
  const program = gl.createProgram();
  shader(gl.VERTEX_SHADER, `in vec3 place; uniform mat4 camera; uniform float size; out vec3 at;
    void main() { at = place; gl_Position = camera * vec4(place, 1.0); gl_PointSize = size; }`);
  // The derivatives of the place across a triangle span it: its shade needs no normals.
  shader(gl.FRAGMENT_SHADER, `in vec3 at; uniform vec4 color; uniform vec3 eye; uniform bool lit; out vec4 shade;
    void main() { float light = 1.0;
      if (lit) light = 0.35 + 0.65 * abs(dot(normalize(cross(dFdx(at), dFdy(at))), normalize(eye - at)));
      shade = vec4(color.rgb * light, color.a); }`);
  gl.linkProgram(program);
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);

  const layers = data.layers.map((layer) => ({ ...layer, ...arrays(layer) }));
  const steps = data.steps.map((step) => ({
    label: step.label,
    bodies: Object.fromEntries(Object.entries(step.bodies).map(([name, x]) => [
      name, arrays(x, layers.find((layer) => layer.name === name).faces),
    ])),
  }));
  for (const layer of layers) { layer.places = gl.createBuffer(); layer.corners = gl.createBuffer(); load(layer); }
  function load(layer) {
    gl.bindBuffer(gl.ARRAY_BUFFER, layer.places);
    gl.bufferData(gl.ARRAY_BUFFER, layer.points, gl.DYNAMIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, layer.corners);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, layer.faces, gl.DYNAMIC_DRAW);
  }

  const [low, high] = data.box, up = unit(data.up), size = Math.hypot(...add(high, low, -1)) || 1;
  const ahead = unit(add(data.ahead, up, -dot(data.ahead, up))), side = cross(up, ahead);
  let middle = add(low, high).map((x) => x / 2), turn = 0.35, tilt = 0.4, distance = 1.2 * size;
  function draw() {
    const width = (canvas.width = canvas.clientWidth * devicePixelRatio);
    const height = (canvas.height = canvas.clientHeight * devicePixelRatio);
    const level = add(ahead.map((x) => x * -Math.cos(turn)), side, Math.sin(turn));
    const back = add(level.map((x) => x * Math.cos(tilt)), up, Math.sin(tilt));
    const eye = add(middle, back, distance), right = unit(cross(up, back)), top = cross(back, right);
    const near = distance / 100, far = distance + 20 * size, focus = 1.8, depth = near - far;
    const rows = [
      [right, (focus * height) / width], [top, focus], [back, (near + far) / depth], [back, -1],
    ].map(([axis, scale]) => [...axis.map((x) => x * scale), -dot(axis, eye) * scale]);
    rows[2][3] += (2 * near * far) / depth;
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.uniformMatrix4fv(uniform("camera"), true, rows.flat());
    gl.uniform3fv(uniform("eye"), eye);
    gl.uniform1f(uniform("size"), 5 * devicePixelRatio);
    for (const layer of [...layers].sort((a, b) => b.opacity - a.opacity)) {
      if (!layer.shown) continue;
      const surface = layer.kind === "surface";
      gl.uniform4f(uniform("color"), ...layer.color.map((x) => x / 255), layer.opacity);
      gl.uniform1i(uniform("lit"), surface);
      gl.bindBuffer(gl.ARRAY_BUFFER, layer.places);
      gl.enableVertexAttribArray(0);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, layer.corners);
      if (surface) gl.drawElements(gl.TRIANGLES, layer.faces.length, gl.UNSIGNED_INT, 0);
      else gl.drawArrays(layer.kind === "lines" ? gl.LINES : gl.POINTS, 0, layer.points.length / 3);
    }
  }

  if (steps.length > 1) {
    slider.parentElement.hidden = false;
    slider.max = slider.value = steps.length - 1;
    slider.addEventListener("input", show);
    show();
  }
  function show() {
    const step = steps[slider.value];
    view.querySelector("output").textContent = step.label;
    for (const layer of layers) if (step.bodies[layer.name]) { Object.assign(layer, step.bodies[layer.name]); load(layer); }
    draw();
  }
  for (const group of new Set(layers.map((layer) => layer.group))) {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox";
    box.checked = layers.find((layer) => layer.group === group).shown;
    box.addEventListener("change", () => {
      for (const layer of layers) if (layer.group === group) layer.shown = box.checked;
      draw();
    });
    label.append(box, ` ${group} `);
    label.style.marginRight = "1em";
    view.querySelector("div").append(label);
  }

  const move = (x, y) => {
    turn -= x;
    tilt = Math.max(-1.5, Math.min(1.5, tilt + y));
  };
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    const [x, y] = [event.movementX, event.movementY].map((d) => d / canvas.clientHeight);
    if (event.shiftKey || event.buttons > 1) {
      const right = add(side.map((s) => -s * Math.cos(turn)), ahead, -Math.sin(turn));
      middle = add(add(middle, right, -x * distance), up, y * distance);
    } else move(4 * x, 4 * y);
    draw();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    distance *= Math.exp(event.deltaY / 800);
    draw();
  }, { passive: false });
  const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
  canvas.addEventListener("keydown", (event) => {
    if (event.key in keys) { event.preventDefault(); move(...keys[event.key]); draw(); }
  });
  addEventListener("resize", draw);
  addEventListener("beforeprint", draw);
  draw();
})();
