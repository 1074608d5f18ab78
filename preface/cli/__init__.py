"""The commands, one small module each: parse, call, report."""
