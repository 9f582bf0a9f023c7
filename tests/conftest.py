"""Every shape and type in softfin's annotations is checked at run time in the tests."""

import jaxtyping

jaxtyping.install_import_hook("softfin", "beartype.beartype")
