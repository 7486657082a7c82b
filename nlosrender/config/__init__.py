"""Stage 1: YAML -> frozen, typed config.

``load_config`` is the way in; ``Config`` is what every later stage reads.
"""
