"""Pages of HTML that need nothing but themselves: pictures inside, no network, light and dark."""
