// Half-precision floats (IEEE 754 binary16) as numbers.

const TABLE = new Float32Array(65536);
for (let bits = 0; bits < 65536; bits++) {
  const exponent = (bits >> 10) & 31, fraction = bits & 1023;
  const size = exponent === 31 ? (fraction ? NaN : Infinity)
    : exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024);
  TABLE[bits] = bits & 0x8000 ? -size : size;
}

/** The number that these 16 bits are. */
export const fromHalf = bits => TABLE[bits];
