"""C99 for a flight controller: fields, steps and the filter of `OnlineAdaptation`."""
