"""Start of Mitsuba: the choice of LLVM or CUDA, and of an LLVM library that works."""
