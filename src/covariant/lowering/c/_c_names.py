"""Names that a C function must not have."""

import re

_C = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while alignas "
    "alignof asm bool constexpr false nullptr static_assert thread_local true typeof typeof_unqual"
)
"""Keywords of C99 and those that C23 adds."""
_CPP = (
    "and and_eq bitand bitor catch char16_t char32_t char8_t class co_await co_return co_yield compl concept "
    "const_cast consteval constinit decltype delete dynamic_cast explicit export friend mutable namespace new "
    "noexcept not not_eq operator or or_eq private protected public reinterpret_cast requires static_cast template "
    "this throw try typeid typename using virtual wchar_t xor xor_eq"
)
"""Further keywords of C++, whose programs may call the function."""
_MATH = (
    "acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh erf erfc exp exp2 expm1 fabs fdim floor fma "
    "fmax fmin fmod frexp hypot ilogb ldexp lgamma llrint llround log log10 log1p log2 logb lrint lround modf nan "
    "nearbyint nextafter nexttoward pow remainder remquo rint round scalbln scalbn sin sinh sqrt tan tanh tgamma trunc "
    "drem finite gamma j0 j1 jn scalb significand y0 y1 yn"
)
"""Functions of <math.h>, each of which also exists with the suffixes f and l; the last line lists those of POSIX."""
_OTHERS = (
    "INFINITY NAN HUGE_VAL HUGE_VALF HUGE_VALL FP_INFINITE FP_NAN FP_NORMAL FP_SUBNORMAL FP_ZERO FP_ILOGB0 FP_ILOGBNAN "
    "MATH_ERRNO MATH_ERREXCEPT double_t float_t fpclassify isfinite isgreater isgreaterequal isinf isless islessequal "
    "islessgreater isnan isnormal isunordered math_errhandling signbit signgam "
    "main abort abs atexit atof atoi atol bsearch calloc clock div errno exit fclose fflush fopen fprintf fputs fread "
    "free fscanf fwrite getc getchar getenv gets labs malloc memchr memcmp memcpy memmove memset printf putc putchar "
    "puts qsort raise rand realloc remove rename scanf signal sprintf srand sscanf strcat strchr strcmp strcpy strlen "
    "strncmp strncpy strstr strtod strtol system time tmpfile vprintf"
)
"""Other names of <math.h>, and C library functions that a function of the same name would hide."""
C_KEYWORDS = frozenset(_C.split() + _CPP.split())
LIBRARY = frozenset(_OTHERS.split() + [f"{name}{suffix}" for name in _MATH.split() for suffix in ("", "f", "l")])


def check_name(name: str) -> None:
    """Raise `ValueError` unless a C function may have this name."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ValueError(f"{name!r} is no name in C; take letters, digits and underscores, beginning with a letter")
    for names, kind in ((C_KEYWORDS, "a keyword of C or C++"), (LIBRARY, "a name of the C library")):
        if name in names:
            raise ValueError(f"{name!r} is {kind}; take another name, such as 'my_{name}'")
