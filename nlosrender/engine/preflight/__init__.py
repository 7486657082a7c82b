"""Before a render: memory, time, omitted work, warnings and light that no technique samples."""
