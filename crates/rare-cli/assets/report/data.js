// From the page's base64 blobs to typed arrays, laid out as the graphics card reads them.

/** The bytes of the blob with this element id. */
function blobBytes(id) {
  const text = document.getElementById(id).textContent.trim();
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const characters = atob(text);
  const bytes = new Uint8Array(characters.length);
  for (let index = 0; index < characters.length; index += 1) bytes[index] = characters.charCodeAt(index);
  return bytes;
}

/**
 * A cloud: `positions` has four 16-bit numbers a point (the fourth is zero), `residuals` and `visibility` four bytes a
 * point, one for each pose: cards read aligned groups of four faster than groups of three.
 */
export function decodeCloud(cloud, poseCount) {
  const bytes = blobBytes(cloud.blob);
  const count = cloud.shown;
  const expected = count * (6 + 2 * poseCount);
  if (bytes.length !== expected) throw new Error(`blob ${cloud.blob} has ${bytes.length} bytes instead of ${expected}`);
  const positions = widen(new Uint16Array(bytes.buffer, bytes.byteOffset, count * 3), count);
  const residuals = gather(bytes, count * 6, count, poseCount);
  const visibility = gather(bytes, count * (6 + poseCount), count, poseCount);
  return { ...cloud, count, positions, residuals, visibility };
}

function widen(triples, count) {
  const wide = new Uint16Array(count * 4);
  for (let point = 0; point < count; point += 1) {
    wide[4 * point] = triples[3 * point];
    wide[4 * point + 1] = triples[3 * point + 1];
    wide[4 * point + 2] = triples[3 * point + 2];
  }
  return wide;
}

/** Planes of bytes, one after the other, to one group of four bytes a point. */
function gather(bytes, start, count, planes) {
  const groups = new Uint8Array(count * 4);
  for (let plane = 0; plane < planes; plane += 1) {
    const offset = start + plane * count;
    for (let point = 0; point < count; point += 1) groups[4 * point + plane] = bytes[offset + point];
  }
  return groups;
}

/** The correspondences of a set: ends in the display frames of source and reference, split into inliers and outliers. */
export function decodeMatches(set) {
  if (set.shown === 0) return { inlier: new Float32Array(0), outlier: new Float32Array(0) };
  const bytes = blobBytes(set.blob);
  const count = set.shown;
  const ends = new Float32Array(bytes.buffer, bytes.byteOffset, count * 6);
  const flags = bytes.subarray(count * 24, count * 25);
  return { inlier: select(ends, flags, 1), outlier: select(ends, flags, 0) };
}

function select(ends, flags, wanted) {
  const chosen = [];
  flags.forEach((flag, index) => { if (flag === wanted) chosen.push(index); });
  const selected = new Float32Array(chosen.length * 6);
  chosen.forEach((from, to) => selected.set(ends.subarray(from * 6, from * 6 + 6), to * 6));
  return selected;
}
