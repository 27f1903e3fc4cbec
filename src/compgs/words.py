"""Numbers with units, as people read them."""


def size(count: float) -> str:
    """Bytes as people write them: `812 B`, `258.1 kB`, `1.24 MB` (powers of 1000)."""
    if count < 1000:
        return f"{count:.0f} B"
    if count < 1e6:
        return f"{count / 1e3:.1f} kB"
    return f"{count / 1e6:.2f} MB" if count < 1e9 else f"{count / 1e9:.2f} GB"


def short_size(count: float) -> str:
    """Bytes with three digits: `900 B`, `20 kB`, `1.54 MB` (powers of 1000)."""
    for factor, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        # What would be rounded to 1000 kB is 1 MB.
        if count >= 0.9995 * factor:
            return f"{float(f'{count / factor:.3g}'):g} {unit}"
    return f"{count:.0f} B"


def duration(seconds: float) -> str:
    """`5.3 ms`, `1.25 s`, `4 min 05 s`."""
    if seconds < 1:
        return f"{seconds * 1e3:.1f} ms"
    if seconds < 60:
        return f"{seconds:.2f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"
