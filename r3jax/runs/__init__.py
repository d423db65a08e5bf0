"""A run on disk: what was seen, what was decided and why, complete after every step.

    runs/NAME/
      run.json         format version, settings, seed, package versions, scene and its hash
      trace.jsonl      one row per view, then one row that says how the run ended
      history.jsonl    when processes began to write, and how earlier ones ended
      timings.jsonl    seconds that each stage took on this machine, per view
      frames/000042.png, 000042.depth.png     8-bit RGB; uint16 depth at 1/5000 m
      checkpoints/     state of the loop: map, grid, policy, totals (Orbax), the last three
      report/  models/  exports/
      .room            64 KiB for the last row of trace.jsonl, while a process writes

What is read back is checked: rows and run.json end with a seal, the SHA-256 of what they say; a
row has the hash of its view's pixels; `sha256.json` in a checkpoint has those of its files, the
header of a model that of its numbers. What an earlier version wrote without is read unchecked.

`trace.jsonl` holds nothing that depends on the machine unless the mission clock does: under
the model clock two equal runs write equal bytes.
"""
