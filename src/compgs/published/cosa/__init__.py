"""Files of COSA-GS (arXiv 2609.30245): anchors in a causal chain.

`shape` names the chain's parts, `chain` walks it in integers, `content` is what a file holds, `reader` opens one.
"""
