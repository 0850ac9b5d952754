"""Closed-loop identification: drives, loops and bodies by simulation, compared with positions."""
