// A run as the same table that `python -m pytest_pafot export --to csv` writes, without loss.

const HEADS = "time,vehicle,x,y,heading,speed,acceleration,steering,lane,length,width";
const SIGNS = [1, -1, -1, 1, 1, -1, 1]; // Signs of the columns of a state: in files y points to the left, and angles are anticlockwise.
const LANE_COLUMN = 6; // This column holds integers.

function pythonText(value) {
  // Writes a float as Python does, with the fewest digits that read back as the same number.
  const size = Math.abs(value);
  if (Object.is(value, -0)) return "-0.0";
  if (size && (size < 1e-4 || size >= 1e16)) return value.toExponential().replace(/e([+-])(\d)$/, (_, sign, digit) => `e${sign}0${digit}`);
  return Number.isInteger(value) ? value.toFixed(1) : String(value);
}

async function seriesOf(finding) {
  // The values of each column of each vehicle, packed as described at drive_view in views.py.
  const packed = Uint8Array.from(atob(finding.drive.states), (letter) => letter.charCodeAt(0));
  const opened = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(opened).arrayBuffer());
  const count = planes.length / 8;
  const bytes = new Uint8Array(planes.length);
  planes.forEach((byte, place) => { bytes[(place % count) * 8 + Math.floor(place / count)] = byte; });
  const bits = new BigInt64Array(bytes.buffer);
  const rows = count / (finding.vehicles.length * SIGNS.length);
  for (const _ of [1, 2]) for (let place = 0; place < count; place += 1) if (place % rows) bits[place] += bits[place - 1];
  return Array.from({ length: count / rows }, (_, index) => new Float64Array(bytes.buffer, index * rows * 8, rows));
}

async function tableOf(finding) {
  const series = await seriesOf(finding);
  const lines = [HEADS];
  for (let tick = 0; tick < series[0].length; tick += 1) {
    const time = pythonText(tick / finding.drive.physics_hz);
    finding.vehicles.forEach((vehicle, index) => {
      const state = SIGNS.map((sign, column) => sign * series[index * SIGNS.length + column][tick]);
      const texts = state.map((value, column) => (column === LANE_COLUMN ? String(value) : pythonText(value)));
      lines.push([time, index ? `npc${index - 1}` : "ego", ...texts, pythonText(vehicle.length), pythonText(vehicle.width)].join(","));
    });
  }
  return `${lines.join("\n")}\n`;
}
