"use strict";
// What a radar sees from one place: the geometry of paths of one bounce, as Link.seen traces them.
const sight = (() => {
  const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const at = (points, k) => [points[3 * k], points[3 * k + 1], points[3 * k + 2]];

  // Corners of all triangles of some surfaces, nine numbers each.
  const triangles = (surfaces) => {
    const found = new Float64Array(surfaces.reduce((sum, x) => sum + 3 * x.faces.length, 0));
    let k = 0;
    for (const { points, faces } of surfaces)
      for (const corner of faces) for (let c = 0; c < 3; c++) found[k++] = points[3 * corner + c];
    return found;
  };

  // Points evenly over the area of triangles: the same ones each time.
  const spread = (corners, count) => {
    const sums = new Float64Array(corners.length / 9);
    let total = 0;
    for (let k = 0; k < sums.length; k++) {
      const a = at(corners, 3 * k);
      const n = cross(minus(at(corners, 3 * k + 1), a), minus(at(corners, 3 * k + 2), a));
      sums[k] = total += Math.sqrt(dot(n, n));
    }
    let state = 1;
    const random = () => (state = (48271 * state) % 2147483647) / 2147483647;
    const found = [];
    for (let i = 0, k = 0; i < count && total > 0; i++) {
      while (sums[k] < ((i + 0.5) / count) * total) k++;
      let s = random(), t = random();
      if (s + t > 1) [s, t] = [1 - s, 1 - t];
      const [a, b, c] = [0, 1, 2].map((n) => at(corners, 3 * k + n));
      found.push(a.map((x, n) => x + s * (b[n] - x) + t * (c[n] - x)));
    }
    return found;
  };

  // A test of whether points are seen from a place: whether no triangle stands between.
  const seen = (corners, place) => {
    // A direction is inside a triangle where its products with the normals of three planes, each
    // through the place and a side, have one sign.
    const planes = new Float64Array((corners.length / 9) * 10);
    for (let k = 0; k < corners.length / 9; k++) {
      const [a, b, c] = [0, 1, 2].map((n) => minus(at(corners, 3 * k + n), place));
      planes.set([...cross(b, c), ...cross(c, a), ...cross(a, b), dot(a, cross(b, c))], 10 * k);
    }
    return (point) => {
      const [x, y, z] = minus(point, place);
      for (let k = 0; k < planes.length; k += 10) {
        const p = x * planes[k] + y * planes[k + 1] + z * planes[k + 2];
        const q = x * planes[k + 3] + y * planes[k + 4] + z * planes[k + 5];
        if (p * q < 0) continue;
        const r = x * planes[k + 6] + y * planes[k + 7] + z * planes[k + 8];
        if (p * r < 0 || q * r < 0) continue;
        const share = planes[k + 9] / (p + q + r);
        if (share > 1e-6 && share < 0.999) return false;
      }
      return true;
    };
  };

  // Sides of triangles as corners a and b, with the corner opposite in each triangle, or -1.
  const known = new WeakMap();
  const sides = (faces) => {
    if (!known.has(faces)) {
      const found = new Map();
      for (let k = 0; k < faces.length; k++) {
        const first = k - (k % 3);
        const [a, b, c] = [faces[k], faces[first + ((k + 1) % 3)], faces[first + ((k + 2) % 3)]];
        const key = Math.min(a, b) * 2 ** 26 + Math.max(a, b), side = found.get(key);
        if (side) side[3] = c; else found.set(key, [a, b, c, -1]);
      }
      known.set(faces, [...found.values()]);
    }
    return known.get(faces);
  };

  // Points on the silhouettes of surfaces: sides whose triangles lie on one side of the line of sight.
  const silhouettes = (surfaces, place, count) => {
    const found = [];
    for (const { points, faces } of surfaces)
      for (const [a, b, c, d] of sides(faces)) {
        const [one, other] = [at(points, a), at(points, b)];
        const plane = cross(minus(one, place), minus(other, place));
        const beyond = (corner) => dot(plane, minus(at(points, corner), place));
        if (d < 0 || beyond(c) * beyond(d) > 0) found.push([one, other]);
      }
    const lengths = found.map(([one, other]) => Math.hypot(...minus(other, one)));
    const apart = lengths.reduce((sum, x) => sum + x, 0) / count;
    let left = 0.5 * apart;
    return found.flatMap(([one, other], k) => {
      const own = [];
      for (; left < lengths[k]; left += apart)
        own.push(one.map((x, n) => x + (left / lengths[k]) * (other[n] - x)));
      left -= lengths[k];
      return own;
    });
  };

  return { minus, dot, triangles, spread, seen, silhouettes };
})();
