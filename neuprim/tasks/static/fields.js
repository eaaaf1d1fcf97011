// In a browser: SphericalHarmonics.
({ degree, channels }, { sh_dc, sh_rest }, count, lib) => {
  const look = lib.harmonics(degree, channels, sh_rest);
  return { at: ({}, eye) => ({ look: (i, centre, out) => look(i, centre, eye, c => sh_dc[channels * i + c], out.base) }) };
}
