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
  const [low, high] = extent(layers.filter((layer) => layer.shown));
  const up = unit(data.up), size = Math.hypot(...add(high, low, -1)) || 1;
  const ground = groundLines();
  layers.push(ground.layer);
  for (const layer of layers) { layer.places = gl.createBuffer(); layer.corners = gl.createBuffer(); load(layer); }
  function load(layer) {
    // A name stands above its object.
    if (layer.group === "twin" || layer.group === "radar") {
      const [least, most] = extent([layer]);
      layer.top = least.map((x, k) => (up[k] > 0.5 ? most[k] : up[k] < -0.5 ? x : (x + most[k]) / 2));
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, layer.places);
    gl.bufferData(gl.ARRAY_BUFFER, layer.points, gl.DYNAMIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, layer.corners);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, layer.faces, gl.DYNAMIC_DRAW);
  }

  // The least and the largest coordinates of all points of some layers; those of the box without any.
  function extent(some) {
    const least = [Infinity, Infinity, Infinity], most = [-Infinity, -Infinity, -Infinity];
    for (const { points } of some)
      for (let k = 0; k < points.length; k++) {
        least[k % 3] = Math.min(least[k % 3], points[k]);
        most[k % 3] = Math.max(most[k % 3], points[k]);
      }
    return least[0] <= most[0] ? [least, most] : data.box;
  }
  const extentOf = (values) => values.reduce(([a, b], x) => [Math.min(a, x), Math.max(b, x)], [Infinity, -Infinity]);
  // 1, 2 or 5 times a power of ten, from a length upwards.
  function roundStep(length) {
    const power = 10 ** Math.floor(Math.log10(Math.max(length, 1e-6)));
    return power * [1, 2, 5, 10].find((k) => k * power >= 0.999 * length);
  }
  // A grid below the scene, with metres along the two sides that the first picture has in front.
  function groundLines() {
    const upright = up.findIndex((x) => Math.abs(x) > 0.5), flat = [0, 1, 2].filter((k) => k !== upright);
    const cell = roundStep(Math.max(...flat.map((k) => high[k] - low[k])) / 6);
    const start = low.map((x) => cell * Math.floor(x / cell));
    const end = high.map((x, k) => Math.max(cell * Math.ceil(x / cell), start[k] + cell));
    const at = (a, first, b, second) => {
      const place = [0, 0, 0];
      place[a] = first;
      place[b] = second;
      place[upright] = up[upright] > 0 ? low[upright] - 1e-3 * cell : high[upright] + 1e-3 * cell;
      return place;
    };
    const lines = [], marks = [];
    for (const [a, b] of [flat, [...flat].reverse()]) {
      const front = data.ahead[b] - 0.2 * cross(up, data.ahead)[b] > 0 ? start[b] : end[b];
      for (let k = 0; k <= Math.round((end[a] - start[a]) / cell); k++) {
        const x = start[a] + k * cell;
        lines.push(...at(a, x, b, start[b]), ...at(a, x, b, end[b]));
        if (x > start[a] && x < end[a] - cell / 2) marks.push([`${+x.toFixed(6)}`, at(a, x, b, front)]);
      }
      marks.push([`${"xyz"[a]} [m]`, at(a, data.ahead[a] < 0 ? start[a] : end[a], b, front)]);
    }
    const none = new Uint32Array(0), color = [128, 134, 144];
    return { marks, layer: { name: "ground", group: "ground", kind: "lines", color, opacity: 0.5, shown: true,
      points: new Float32Array(lines), faces: none } };
  }

  const ahead = unit(add(data.ahead, up, -dot(data.ahead, up))), side = cross(up, ahead);
  const focus = 1.8, words = part("words").getContext("2d"), dark = matchMedia("(prefers-color-scheme: dark)");
  let middle = add(low, high).map((x) => x / 2), turn = 0.21, tilt = 0.49, distance = 0;
  function axesOfCamera() {
    const level = add(ahead.map((x) => x * -Math.cos(turn)), side, Math.sin(turn));
    const back = add(level.map((x) => x * Math.cos(tilt)), up, Math.sin(tilt)), right = unit(cross(up, back));
    return [right, cross(back, right), back];
  }
  // The first picture holds all that is shown, in its middle.
  function frame() {
    const [right, top, back] = axesOfCamera(), room = Math.min(canvas.clientWidth / canvas.clientHeight, 1.6);
    // Of fine meshes some thousand points tell where they end.
    const points = layers.filter((layer) => layer.shown).flatMap((layer) => {
      const count = layer.points.length / 3, apart = Math.ceil(count / 5000) || 1;
      return Array.from({ length: Math.ceil(count / apart) }, (_, k) => layer.points.subarray(3 * k * apart, 3 * k * apart + 3));
    });
    for (let turns = 0; turns < 3; turns++) {
      let most = 0;
      for (const point of points) {
        const away = add(point, middle, -1), wide = Math.abs(dot(away, right)) / room;
        most = Math.max(most, dot(away, back) + (focus / 0.88) * Math.max(wide, Math.abs(dot(away, top))));
      }
      distance = most || size;
      for (const axis of [right, top]) {
        const seen = extentOf(points.map((point) => {
          const away = add(point, middle, -1);
          return dot(away, axis) / (distance - dot(away, back));
        }));
        middle = add(middle, axis, (distance * (seen[0] + seen[1])) / 2);
      }
    }
  }
  function draw(event) {
    const width = (canvas.width = words.canvas.width = canvas.clientWidth * devicePixelRatio);
    const height = (canvas.height = words.canvas.height = canvas.clientHeight * devicePixelRatio);
    const [right, top, back] = axesOfCamera(), eye = add(middle, back, distance);
    const near = distance / 100, far = distance + 20 * size, depth = near - far;
    const rows = [
      [right, (focus * height) / width], [top, focus], [back, (near + far) / depth], [back, -1],
    ].map(([axis, scale]) => [...axis.map((x) => x * scale), -dot(axis, eye) * scale]);
    rows[2][3] += (2 * near * far) / depth;
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
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
    write(rows, width, height, dark.matches && event?.type !== "beforeprint");
  }
  // Names and metres, inside of the picture, and none over another.
  function write(rows, width, height, light) {
    const written = [], scale = devicePixelRatio, named = layers.filter((layer) => layer.shown && layer.top);
    words.lineWidth = 3 * scale;
    words.lineJoin = "round";
    words.textAlign = "center";
    words.textBaseline = "middle";
    const put = (text, place, [x, y, , w] = rows.map((row) => dot(row.slice(0, 3), place) + row[3])) => {
      const half = words.measureText(text).width / 2 + 3 * scale, line = 8 * scale;
      const across = Math.min(Math.max((0.5 + x / w / 2) * width, half), width - half), down = (0.5 - y / w / 2) * height;
      const meets = ([a, b, c]) => Math.abs(a - across) < half + c && Math.abs(b - down) < 2 * line;
      if (w <= 0 || Math.abs(x / w) > 1 || Math.abs(y / w) > 0.97 || written.some(meets)) return;
      written.push([across, down, half]);
      words.strokeText(text, across, down);
      words.fillText(text, across, down);
    };
    words.strokeStyle = light ? "#15181ccc" : "#ffffffcc";
    words.fillStyle = light ? "#e6e8eb" : "#1b1f24";
    words.font = `${13 * scale}px system-ui, sans-serif`;
    for (const layer of named) put(layer.name.slice(layer.name.indexOf("/") + 1).slice(0, 24), add(layer.top, up, 0.03 * distance));
    if (!ground.layer.shown) return;
    words.fillStyle = light ? "#a8afb9" : "#59616d";
    words.font = `${11 * scale}px system-ui, sans-serif`;
    for (const [text, place] of ground.marks) put(text, place);
  }

  const colors = { power: new Uint8Array(bytes(data.colors.power)), apart: new Uint8Array(bytes(data.colors.apart)) };
  const named = data.pictures, pictures = new Map();
  let own = sensors[0], position = 0, chosen = null, waiting;
  for (const name of [named.measured, named.simulated, named.residual]) {
    const figure = document.createElement("figure"), picture = document.createElement("canvas");
    const box = document.createElement("div"), bar = document.createElement("canvas");
    figure.style.margin = 0;
    figure.append(name === named.residual ? `${name} [dB]` : `${name} [dB below peak]`, box);
    box.style = "position: relative; margin: .4rem 3rem 1.5rem 2rem; font-size: 11px; line-height: 1";
    bar.style = "position: absolute; left: calc(100% + 6px); top: 0; width: 9px; height: 100%";
    bar.ariaHidden = "true";
    drawBar(bar, name === named.residual ? colors.apart : colors.power);
    box.append(picture, bar);
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
  axes.textContent = "range [m] upwards, azimuth [°] to the left";
  part("maps").append(axes);
  function drawBar(bar, table) {
    [bar.width, bar.height] = [1, 256];
    const image = new ImageData(1, 256);
    for (let k = 0; k < 256; k++) image.data.set([...table.subarray(3 * (255 - k), 3 * (256 - k)), 255], 4 * k);
    bar.getContext("2d").putImageData(image, 0, 0);
  }
  // Metres, degrees and decibels beside the bins of a map.
  function mark(picture, name) {
    for (const old of picture.parentElement.querySelectorAll("span")) old.remove();
    const put = (text, style) => {
      const label = document.createElement("span");
      label.textContent = text;
      label.style = `position: absolute; white-space: nowrap; ${style}`;
      picture.parentElement.append(label);
    };
    const [ends, steps] = [[center(0, 0), center(...own.shape)], [own.grid[1], own.grid[3]]];
    const [[near, first], [far, last]] = ends.map((end) => end.map((x, k) => x - steps[k] / 2));
    const apart = roundStep((far - near) / 4);
    for (let x = apart * Math.ceil(near / apart); x <= far; x += apart)
      put(+x.toFixed(6), `right: calc(100% + 4px); bottom: ${(100 * (x - near)) / (far - near)}%; transform: translateY(50%)`);
    const angle = (u) => (180 / Math.PI) * Math.asin(Math.max(-1, Math.min(1, u)));
    const turn = [5, 10, 15, 30].find((x) => (angle(last) - angle(first)) / x < 6) ?? 30;
    for (let x = turn * Math.ceil(angle(first) / turn); own.shape[1] > 1 && x <= angle(last); x += turn) {
      const left = (last - Math.sin((x * Math.PI) / 180)) / (last - first);
      if (Math.abs(x) < 75) put(x, `top: calc(100% + 4px); left: ${100 * left}%; transform: translateX(-50%)`);
    }
    const levels = name === named.residual ? [data.largest, 0, -data.largest] : [0, -data.depth / 2, -data.depth];
    levels.forEach((level, k) => put(level, `left: calc(100% + 19px); top: ${50 * k}%; transform: translateY(-50%)`));
  }
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
    pictures.forEach(mark);
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
    slider.max = steps.length - 1;
    slider.value = data.initial_step;
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
  const bands = layers.filter((layer) => layer.group === "levels" && layer.band);
  if (bands.length > 1) {
    const label = document.createElement("label"), slider = document.createElement("input"), said = document.createElement("output");
    Object.assign(slider, { type: "range", min: 0, max: bands.length - 1, value: 0 });
    const hide = () => {
      const shown = bands.some((layer) => layer.shown);
      bands.forEach((layer, k) => { layer.hidden = k < slider.value; layer.shown = shown && !layer.hidden; });
      const { band, unit } = bands[slider.value];
      said.textContent = ` from ${Number(band[0].toPrecision(4))} ${unit} up`;
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
  for (const name of ["resize", "beforeprint", "afterprint"]) addEventListener(name, draw);
  dark.addEventListener("change", draw);
  frame();
  if (own) sense(0);
  else draw();
})();
