(() => {
  const view = document.getElementById("view");
  const data = JSON.parse(document.getElementById("view-data").textContent);
  const part = (name) => view.querySelector(`[data-part="${name}"]`);
  const canvas = view.querySelector("canvas"), slider = part("step");
  // What was drawn stays, so that it is printed too.
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) { canvas.hidden = true; part("none").hidden = false; return; }

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
  const sensors = data.sensors.map((x) => ({
    ...x,
    measured: x.measured && new Uint8Array(bytes(x.measured)),
    simulated: x.simulated && x.simulated.map((text) => new Uint8Array(bytes(text))),
  }));
  // What the chosen position sees is found here, of the surfaces of the twin as they are.
  const surfaces = layers.filter((x) => x.group === "twin" && x.kind === "surface");
  const [paths, visible, edges, feeding] = data.position.map((x) => ({
    ...x, group: x.name, kind: "points", opacity: 1, points: new Float32Array(0), faces: new Uint32Array(0),
  }));
  paths.kind = "lines";
  if (surfaces.length && sensors.some((x) => x.places.length)) layers.push(paths, visible, edges, feeding);
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
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.uniformMatrix4fv(uniform("camera"), true, rows.flat());
    gl.uniform3fv(uniform("eye"), eye);
    // Points on a surface are not hidden by it.
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(3, 8);
    for (const layer of [...layers].sort((a, b) => !!a.through - !!b.through || b.opacity - a.opacity)) {
      if (!layer.shown) continue;
      const surface = layer.kind === "surface";
      if (layer.through) gl.disable(gl.DEPTH_TEST); else gl.enable(gl.DEPTH_TEST);
      // From outside one sees into a room: the triangles of its walls face inwards.
      if (layer.wall) gl.enable(gl.CULL_FACE); else gl.disable(gl.CULL_FACE);
      gl.uniform4f(uniform("color"), ...layer.color.map((x) => x / 255), layer.opacity);
      gl.uniform1i(uniform("lit"), surface);
      gl.uniform1f(uniform("size"), 5 * devicePixelRatio * (layer.size ?? 1));
      gl.bindBuffer(gl.ARRAY_BUFFER, layer.places);
      gl.enableVertexAttribArray(0);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, layer.corners);
      if (surface) gl.drawElements(gl.TRIANGLES, layer.faces.length, gl.UNSIGNED_INT, 0);
      else gl.drawArrays(layer.kind === "lines" ? gl.LINES : gl.POINTS, 0, layer.points.length / 3);
    }
  }

  const colors = { power: new Uint8Array(bytes(data.colors.power)), apart: new Uint8Array(bytes(data.colors.apart)) };
  const named = data.pictures, pictures = new Map();
  let own = sensors[0], position = 0, chosen = null, waiting;
  for (const name of [named.measured, named.simulated, named.residual]) {
    const figure = document.createElement("figure"), picture = document.createElement("canvas");
    figure.style.margin = 0;
    figure.append(name, picture);
    picture.tabIndex = 0;
    picture.style = "display: block; width: 100%; height: 7rem; cursor: crosshair";
    picture.setAttribute("role", "img");
    picture.setAttribute("aria-label", `${name} map: click a bin, or move with the arrow keys`);
    picture.addEventListener("click", (event) => {
      const [rows, columns] = own.shape;
      choose(rows - 1 - Math.floor((rows * event.offsetY) / picture.clientHeight),
        columns - 1 - Math.floor((columns * event.offsetX) / picture.clientWidth));
    });
    const moves = { ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, 1], ArrowRight: [0, -1] };
    picture.addEventListener("keydown", (event) => {
      if (!(event.key in moves)) return;
      event.preventDefault();
      choose(...add(chosen ?? own.shape.map((x) => Math.floor(x / 2)), moves[event.key]));
    });
    pictures.set(name, picture);
    part("maps").append(figure);
  }
  const axes = document.createElement("small");
  part("maps").append(axes);
  function choose(...bin) {
    chosen = bin.map((x, n) => Math.max(0, Math.min(own.shape[n] - 1, x)));
    follow();
  }
  const center = (row, column) => [own.grid[0] + row * own.grid[1], own.grid[2] + column * own.grid[3]];

  // Maps follow at once; points, which take longer, once nothing moves.
  function follow() {
    if (own) {
      const [rows, columns] = own.shape;
      const map = (all) => all && all.subarray(position * rows * columns, (position + 1) * rows * columns);
      const measured = map(own.measured), simulated = map(own.simulated && own.simulated[steps.length ? slider.value : 0]);
      const share = data.depth / (2 * data.largest);  // of what residuals span
      const apart = measured && simulated &&
        Uint8ClampedArray.from(measured, (x, k) => 127.5 + share * (x - simulated[k]));
      paint(named.measured, measured, colors.power);
      paint(named.simulated, simulated, colors.power);
      paint(named.residual, apart, colors.apart);
      clearTimeout(waiting);
      waiting = setTimeout(look, 150);
    }
    draw();
  }
  // The farthest range is on top, and u grows to the left, as the scene does beside it.
  function paint(name, values, table) {
    const picture = pictures.get(name), [rows, columns] = own.shape;
    picture.parentElement.hidden = !values;
    if (!values) return;
    const image = new ImageData(columns, rows);
    values.forEach((value, k) => {
      const to = 4 * (values.length - 1 - k);
      image.data.set(table.subarray(3 * value, 3 * value + 3), to);
      image.data[to + 3] = 255;
    });
    const small = new OffscreenCanvas(columns, rows);
    small.getContext("2d").putImageData(image, 0, 0);
    const [wide, high] = [columns, rows].map((count) => Math.ceil(300 / count));
    picture.width = wide * columns;
    picture.height = high * rows;
    const pen = picture.getContext("2d");
    pen.imageSmoothingEnabled = false;
    pen.drawImage(small, 0, 0, picture.width, picture.height);
    if (chosen === null) return;
    pen.strokeStyle = "rgb(255, 60, 60)";
    pen.lineWidth = 4;
    pen.strokeRect((columns - 1 - chosen[1]) * wide - 2, (rows - 1 - chosen[0]) * high - 2, wide + 4, high + 4);
  }
  // What the position sees, its silhouettes, its paths, and the points that feed the chosen bin.
  function look() {
    if (chosen !== null) {
      const [range, u] = center(...chosen);
      part("told").textContent = `range ${range.toFixed(2)} m, u ${u.toFixed(3)}`;
    }
    const place = own.places[position], found = new Map([paths, visible, edges, feeding].map((x) => [x, []]));
    if (place && surfaces.length) {
      const corners = sight.triangles(surfaces), clear = sight.seen(corners, place);
      const [front, left] = [0, 1].map((n) => own.rotations[position].map((row) => row[n]));
      const before = (point) => sight.dot(sight.minus(point, place), front) > 0 && clear(point);
      const most = Math.min(1500, Math.ceil(3e8 / corners.length));  // tests that take a moment
      found.set(visible, sight.spread(corners, most).filter(before));
      found.set(paths, found.get(visible).filter((_, k) => k % 15 === 0).flatMap((point) => [place, point]));
      found.set(edges, sight.silhouettes(surfaces, place, 600).filter(before));
      if (chosen !== null) {
        const near = sight.spread(corners, 20000).filter((point) => {
          const away = sight.minus(point, place), range = Math.hypot(...away);
          const row = (range - own.origins[position] - own.grid[0]) / own.grid[1];
          const column = own.shape[1] > 1 ? (sight.dot(away, left) / range - own.grid[2]) / own.grid[3] : 0;
          return Math.abs(row - chosen[0]) <= 1 && Math.abs(column - chosen[1]) <= 1;
        });
        const apart = Math.ceil((2 * near.length) / most);
        found.set(feeding, near.filter((_, k) => k % apart === 0).filter(before));
        part("told").textContent += `: ${found.get(feeding).length} points of surfaces feed it`;
      }
    }
    for (const [layer, points] of found) { layer.points = new Float32Array(points.flat()); load(layer); }
    draw();
  }
  function sense(number) {
    own = sensors[number];
    position = 0;
    chosen = null;
    const to = part("position");
    to.parentElement.hidden = own.frames.length < 2;
    to.max = own.frames.length - 1;
    to.value = 0;
    to.nextElementSibling.textContent = own.frames[0];
    const ends = [center(0, 0), center(...add(own.shape, [1, 1], -1))];
    axes.textContent = `range upwards from ${ends[0][0].toFixed(2)} to ${ends[1][0].toFixed(2)} m, ` +
      `u from ${ends[1][1].toFixed(2)} on the left to ${ends[0][1].toFixed(2)}; ` +
      `${data.depth} dB below the peak, residual ±${data.largest} dB`;
    part("told").textContent = "Click a bin of a map: the points that feed it light up.";
    follow();
  }
  if (own) {
    part("maps").hidden = part("told").hidden = false;
    part("sensor").parentElement.hidden = sensors.length < 2;
    part("sensor").append(...sensors.map((x, number) => new Option(x.name, number)));
    part("sensor").addEventListener("change", (event) => sense(event.target.value));
    part("position").addEventListener("input", (event) => {
      position = Number(event.target.value);
      event.target.nextElementSibling.textContent = own.frames[position];
      follow();
    });
  }

  if (steps.length > 1) {
    slider.parentElement.hidden = false;
    slider.max = slider.value = steps.length - 1;
    slider.addEventListener("input", show);
    show();
  }
  function show() {
    const step = steps[slider.value];
    slider.nextElementSibling.textContent = step.label;
    for (const layer of layers) if (step.bodies[layer.name]) { Object.assign(layer, step.bodies[layer.name]); load(layer); }
    follow();
  }
  for (const group of new Set(layers.map((layer) => layer.group))) {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox";
    box.checked = layers.find((layer) => layer.group === group).shown;
    box.addEventListener("change", () => {
      for (const layer of layers) if (layer.group === group) layer.shown = box.checked && !layer.hidden;
      draw();
    });
    label.append(box);
    // The colours of what is drawn are its key.
    for (const color of new Set(layers.filter((layer) => layer.group === group).map((layer) => `rgb(${layer.color})`))) {
      const key = document.createElement("span");
      key.textContent = " ■";
      key.ariaHidden = "true";
      key.style = `color: ${color}; print-color-adjust: exact; -webkit-print-color-adjust: exact`;
      label.append(key);
    }
    label.append(` ${group} `);
    label.style = "display: inline-block; margin-right: 1em";
    part("layers").append(label);
  }
  // Bands of a map of levels come with the lowest first, which the slider hides.
  const bands = layers.filter((layer) => layer.group === "levels");
  if (bands.length > 1) {
    const label = document.createElement("label"), slider = document.createElement("input"), said = document.createElement("output");
    Object.assign(slider, { type: "range", min: 0, max: bands.length - 1, value: 0 });
    const hide = () => {
      const shown = bands.some((layer) => layer.shown);
      bands.forEach((layer, k) => { layer.hidden = k < slider.value; layer.shown = shown && !layer.hidden; });
      said.textContent = ` from ${bands[slider.value].name.split("/")[1].split(" ")[0]} up`;
      draw();
    };
    slider.addEventListener("input", hide);
    label.append("lowest level ", slider, said);
    part("layers").append(label);
    hide();
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
  if (own) sense(0);
  else draw();
})();
