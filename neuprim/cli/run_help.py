"""What ``neuprim run --help`` says beside its arguments."""

from __future__ import annotations

__all__ = ["COMMON_KEYS", "EXAMPLES"]

COMMON_KEYS = """\
commonest keys:
  task=NAME scene=NAME preset=NAME     what to fit, and how (`neuprim tasks` lists them)
  effort=N                             1 (fast) to 9 (good): how many primitives and views, where the task has measured it
  scene.path=DIR                       data of a scene that reads files
  output_dir=DIR resume=true           where to write; continue an interrupted run
  train.iterations=N train.max_seconds=S
  model.primitives=N model.neurons=K model.sh_degree=D
  train.rates.NAME=R                   learning rate of one parameter; train.rate_units.NAME=absolute|extent
  renderer.backend=auto|NAME           `neuprim doctor` lists them
  renderer.sort=center|entry           renderer.samples=N (rays per pixel side) renderer.threads=N
  seed=N
  viewer=true viewer.port=N            look at the model in the browser while it is trained; pause, step, save, stop
  target.psnr=DB budget=10m            the smallest model that has it, searched and trained in that time; also target.ssim=S,
                                       with target.megabytes=M and target.fps=F as limits, or these alone: the best within them
  launcher=inline|processes|ray|slurm  where runs work; launcher.workers=N launcher.threads=N launcher.retries=N
                                       launcher.address=... launcher.options.KEY=VALUE (docs/launching.md)
  scene.cache=DIR|URL                  volumes: where their ground truth is kept (`neuprim truth` makes it before)
`neuprim run task=NAME scene=NAME --cfg` shows every key with its value. A value that contains , = or brackets is quoted
twice, for the shell and for the grammar: "scene.path='a=b, c'"."""

EXAMPLES = """\
examples:
  neuprim run task=dynamic scene=smoke_fire
  neuprim run task=dynamic scene=vdb scene.vdb=DIR scene.frames=0:100:2
  neuprim run task=static scene=solids
  neuprim run task=static scene=blender scene.path=DIR preset=paper
  neuprim run -m model.primitives=200,1000 train.max_seconds=60 launcher=processes
  neuprim run --config RUN_DIR/config.yaml seed=1
  torchrun --nproc-per-node 2 -m neuprim run task=static scene=solids      (one scene by two processes)"""
