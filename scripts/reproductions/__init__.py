"""The paper's experiments, one file each: `measure(study)` runs or collects and returns results, `section(results)` says them in words."""
