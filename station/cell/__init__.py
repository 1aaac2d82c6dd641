"""What every part of the station may know: configuration, plan, limits, status, errors, folders."""
