"""What files of several methods are made of, one idea a file; none of it knows a method.

| file | idea |
|---|---|
| `levels` | values as whole numbers between their smallest and largest |
| `indices` | indices of a codebook in as many bits as they need, or as counts |
| `histogram` | symbols under the histogram that they have |
| `content` | what a method trained, as its file will hold it |

Space-filling order is `compgs.formats.sog.morton_order`, bits are `compgs.formats.packed.packed_bits`.
"""
