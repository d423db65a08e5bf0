"""A run on disk: frames, decisions and their reasons, complete after every step.

    runs/NAME/
      run.json         format version, settings, seed, package versions, scene and its hash
      trace.jsonl      one row per view, then one row that says how the run ended
      history.jsonl    when processes began to write, and how earlier ones ended
      timings.jsonl    seconds that each stage took on this machine, per view
      frames/000042.png, 000042.depth.png     8-bit RGB; uint16 depth at 1/5000 m
      checkpoints/     state of the loop: map, grid, policy, totals (Orbax), the last three
      report/  models/  exports/
      .room            64 KiB for the last row of trace.jsonl, while a process writes

Everything is checked when read: rows and run.json end with a seal, the SHA-256 of their content; a
row has the hash of its view's pixels; `sha256.json` in a checkpoint has those of its files, and the
header of a model that of its numbers. Files of earlier versions without hashes are read unchecked.

`trace.jsonl` contains nothing that depends on the machine, except through the wall clock: with the
model clock equal runs write equal bytes.
"""
