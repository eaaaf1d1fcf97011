// In a browser: CosineDensity. See docs/plugin_reference.md, "Web pages".
({ neurons, omega0 = 30, edge = 0 }, { b2, log_gain }, count, lib) => {
  const gains = lib.gains(log_gain, count);
  const frame = { weight: i => gains[i], offset: i => b2[i] };
  return { neurons, omega0, edge, at: () => frame };
}
