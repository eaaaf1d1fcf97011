"""`neuprim export --format spectra`: centre and spectrum of every primitive, as a table or as JSON."""

import torch

from neuprim.core.errors import ConfigError
from neuprim.core.extensions import Exporter, ExportReport
from neuprim.core.io.files import write_json, write_text
from neuprim_spectral.bands import BANDS
from neuprim_spectral.fields import spectrum


def write(job):
    model = job.run.model
    if job.run.task.name != "spectral":
        raise ConfigError(
            f"--format spectra: {job.run.directory} is a run of task {job.run.task.name!r}; expected 'spectral'"
        )
    (conditions,) = job.frames()
    digits, most = job.count("digits", 0, 12), job.count("most", 1, 10**9)
    with torch.no_grad():
        geometry, _ = model.lower_density(conditions)
        rows = torch.cat(
            [geometry.means, spectrum(model.of(model.colour)["logit"], conditions["wavelength_shift"])], 1
        )[:most].tolist()
    names = ("x", "y", "z", *BANDS)
    values = [[round(x, digits) for x in row] for row in rows]
    if job.out.suffix == ".json":
        write_json(job.out, [dict(zip(names, row, strict=True)) for row in values])
    else:
        write_text(
            job.out, "\n".join([",".join(names), *(",".join(f"{x:.{digits}f}" for x in row) for row in values)]) + "\n"
        )
    notes = (f"{len(values)} of {model.count} primitives; centres in scene units, linear light; no density",)
    return ExportReport((job.out,), lossless=False, notes=notes)


SPECTRA = Exporter(
    api=1,
    name="spectra",
    summary="centre and spectrum of every primitive, .csv or .json",
    write=write,
    options={"digits": (6, "decimal places"), "most": (100_000, "rows that are written")},
    conditions=True,
    default="spectra.csv",
    suffixes=(".csv", ".json"),
)
