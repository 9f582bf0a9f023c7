/* Regions of mean forces (softfin.gaits.reachable): cells {low, high} and the star-shaped region {centre, radius}. */

/* Distance outside a region within which forces count as inside, as a fraction of its largest radius. */
const EDGE_FRACTION = 4e-4;

const distanceTo = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);

class Reachable {
  constructor({ centre_n, radius_n }) {
    this.centre = centre_n;
    this.tolerance = EDGE_FRACTION * Math.max(...radius_n);
    this.offsets = radius_n.map((radius, k) => {
      const angle = (2 * Math.PI * k) / radius_n.length;
      return [radius * Math.cos(angle), radius * Math.sin(angle)];
    });
    this.corners = this.offsets.map(([x, y]) => [centre_n[0] + x, centre_n[1] + y]);
  }

  /* The force, or where the line from it to the centre meets the edge. */
  project(force) {
    const count = this.offsets.length, x = force[0] - this.centre[0], y = force[1] - this.centre[1];
    const turn = ((((Math.atan2(y, x) / (2 * Math.PI)) % 1) + 1) % 1) * count, first = Math.floor(turn) % count;
    const [ax, ay] = this.offsets[first], [bx, by] = this.offsets[(first + 1) % count];
    const across = x * (ay - by) - y * (ax - bx), reach = (ax * (ay - by) - ay * (ax - bx)) / Math.min(across, -1e-9);
    return reach >= 1 ? force : [this.centre[0] + x * reach, this.centre[1] + y * reach];
  }

  contains(force) {
    return distanceTo(this.project(force), force) <= this.tolerance;
  }
}

const nearestOf = (points, force) => points.reduce((best, point) => (best === null || distanceTo(point, force) < distanceTo(best, force) ? point : best), null);

const withinCell = (cell, [x, y]) => [clip(x, cell.low[0], cell.high[0]), clip(y, cell.low[1], cell.high[1])];

/* The first of the cells that are nearest to a force. */
function nearestCellTo(cells, force) {
  const distances = cells.map((cell) => distanceTo(withinCell(cell, force), force));
  return cells[distances.indexOf(Math.min(...distances))];
}

/* The reachable force in a cell that is nearest to a target; null if there is none. */
function nearestReference(cells, reachable, force) {
  if (reachable === null) return nearestOf(cells.map((cell) => withinCell(cell, force)), force);
  const points = [];
  for (const cell of cells) {
    const [x, y] = withinCell(cell, force);
    for (const a of [x, cell.low[0], cell.high[0]]) {
      for (const b of [y, cell.low[1], cell.high[1]]) if (reachable.contains([a, b])) points.push([a, b]);
    }
    reachable.corners.forEach((start, k) => {
      const end = reachable.corners[(k + 1) % reachable.corners.length], side = [end[0] - start[0], end[1] - start[1]];
      // The part of the side that is in the cell (Liang and Barsky 1984).
      let enter = 0, leave = 1;
      for (const axis of [0, 1]) {
        const bounds = [cell.low[axis], cell.high[axis]].map((bound) => (bound - start[axis]) / side[axis]);
        if (side[axis] !== 0) [enter, leave] = [Math.max(enter, Math.min(...bounds)), Math.min(leave, Math.max(...bounds))];
        else if (start[axis] < cell.low[axis] || start[axis] > cell.high[axis]) leave = -1;
      }
      if (enter > leave) return;
      const along = dot([force[0] - start[0], force[1] - start[1]], side) / Math.max(dot(side, side), 1e-12), place = clip(along, enter, leave);
      points.push(withinCell(cell, [start[0] + place * side[0], start[1] + place * side[1]]));
    });
  }
  return nearestOf(points, force);
}
