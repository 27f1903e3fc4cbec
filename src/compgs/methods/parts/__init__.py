"""What several methods of the comparison are made of, one idea a file; none of it knows a method.

| file | idea | computes on |
|---|---|---|
| `vector_quantization` | codebooks: k-means, moving averages, several stages | torch |
| `fake_quantization` | rounded values with gradients that ignore the rounding | torch |
| `significance` | what splats add to the training views, and which of them go | torch |
| `levels` | values as whole numbers between their smallest and largest | numpy |
| `indices` | indices of a codebook in as many bits as they need, or as counts | numpy |
| `books` | how many entries codebooks have | |
| `content` | what a method trained, as its file will hold it | numpy |

What a file is opened with (numpy) loads no torch. Space-filling order is `compgs.formats.sog.morton_order`, bits are
`compgs.formats.packed.packed_bits`.
"""
