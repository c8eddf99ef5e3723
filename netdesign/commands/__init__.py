"""The commands: each parses, calls a verb and prints its result; heavy imports wait until a verb is called."""
