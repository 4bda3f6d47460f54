"""Steps that need the whole log: tables in, messages out."""
