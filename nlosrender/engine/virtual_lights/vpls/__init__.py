"""Virtual point lights (VPLs, Keller 1997): bounces 4 and up."""
