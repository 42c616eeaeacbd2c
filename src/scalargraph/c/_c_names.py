"""Lists the names that a C function must not have, such as keywords and names of the standard library."""

import re

from scalargraph.errors import InputError

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
    "drem finite gamma j0 j1 jn scalb significand y0 y1 yn "
    "cabs cacos cacosh carg casin casinh catan catanh ccos ccosh cexp cimag clog conj cpow cproj creal csin csinh "
    "csqrt ctan ctanh"
)
"""Functions of <math.h> and <complex.h>, which also exist with the suffixes f and l; the fifth line of the list is from
POSIX."""
_MACROS = (
    "INFINITY NAN HUGE_VAL HUGE_VALF HUGE_VALL MATH_ERRNO MATH_ERREXCEPT math_errhandling signgam NULL EOF BUFSIZ "
    "EDOM EILSEQ ERANGE errno stdin stdout stderr linux unix"
)
"""Macros that stand for a value; some compilers define the last two to name the target system."""
_OTHERS = (
    "fpclassify isfinite isgreater isgreaterequal isinf isless islessequal islessgreater isnan isnormal isunordered "
    "signbit main FILE L_tmpnam CLOCKS_PER_SEC EXIT_FAILURE EXIT_SUCCESS WEOF CMPLX CMPLXF CMPLXL ONCE_FLAG_INIT I "
    "complex imaginary noreturn offsetof assert setjmp longjmp jmp_buf tm lconv timespec va_arg va_copy va_end "
    "va_list va_start "
    "abort abs aligned_alloc asctime at_quick_exit atexit atof atoi atol atoll bsearch btowc c16rtomb c32rtomb "
    "call_once calloc clearerr clock cnd_broadcast cnd_destroy cnd_init cnd_signal cnd_timedwait cnd_wait ctime "
    "difftime div exit fclose feclearexcept fegetenv fegetexceptflag fegetround feholdexcept feof feraiseexcept ferror "
    "fesetenv fesetexceptflag fesetround fetestexcept feupdateenv fflush fgetc fgetpos fgets fgetwc fgetws fopen "
    "fprintf fputc fputs fputwc fputws fread free freopen fscanf fseek fsetpos ftell fwide fwprintf fwrite fwscanf "
    "getc getchar getenv gets getwc getwchar gmtime imaxabs imaxdiv isalnum isalpha isblank iscntrl isdigit isgraph "
    "islower isprint ispunct isspace isupper iswalnum iswalpha iswblank iswcntrl iswctype iswdigit iswgraph iswlower "
    "iswprint iswpunct iswspace iswupper iswxdigit isxdigit kill_dependency labs ldiv llabs lldiv localeconv localtime "
    "malloc mblen mbrlen mbrtoc16 mbrtoc32 mbrtowc mbsinit mbsrtowcs mbstowcs mbtowc memchr memcmp memcpy memmove "
    "memset mktime mtx_destroy mtx_init mtx_lock mtx_timedlock mtx_trylock mtx_unlock perror printf putc putchar puts "
    "putwc putwchar qsort quick_exit raise rand realloc remove rename rewind scanf setbuf setlocale setvbuf signal "
    "snprintf sprintf srand sscanf strcat strchr strcmp strcoll strcpy strcspn strerror strftime strlen strncat "
    "strncmp strncpy strpbrk strrchr strspn strstr strtod strtof strtoimax strtok strtol strtold strtoll strtoul "
    "strtoull strtoumax strxfrm swprintf swscanf system thrd_create thrd_current thrd_detach thrd_equal thrd_exit "
    "thrd_join thrd_sleep thrd_yield time timespec_get tmpfile tmpnam tolower toupper towctrans towlower towupper "
    "tss_create tss_delete tss_get tss_set ungetc ungetwc vfprintf vfscanf vfwprintf vfwscanf vprintf vscanf vsnprintf "
    "vsprintf vsscanf vswprintf vswscanf vwprintf vwscanf wcrtomb wcscat wcschr wcscmp wcscoll wcscpy wcscspn wcsftime "
    "wcslen wcsncat wcsncmp wcsncpy wcspbrk wcsrchr wcsrtombs wcsspn wcsstr wcstod wcstof wcstoimax wcstok wcstol "
    "wcstold wcstoll wcstombs wcstoul wcstoull wcstoumax wcsxfrm wctob wctomb wctrans wctype wmemchr wmemcmp wmemcpy "
    "wmemmove wmemset wprintf wscanf"
)
"""Other names of the C11 library; a function or a C++ namespace of the same name would hide them."""
_PATTERNS = re.compile(
    r"[A-Za-z0-9_]+_t|(ATOMIC|DBL|FE|FLT|FP|LC|LDBL|SEEK|SIG|TIME|TSS)_[A-Z0-9_]+|[A-Z0-9_]+_(BIT|DIG|MAX|MIN)|"
    r"(PRI|SCN)[Xdioux][A-Z0-9]+|SIG(ABRT|FPE|ILL|INT|SEGV|TERM)|U?INT(8|16|32|64|MAX)_C|atomic_[a-z_]+"
)
"""Families of types, macros and functions of the library."""
C_KEYWORDS = frozenset(_C.split() + _CPP.split())
C_MACROS = frozenset(_MACROS.split())
LIBRARY = C_MACROS | frozenset(
    _OTHERS.split() + [f"{name}{suffix}" for name in _MATH.split() for suffix in ("", "f", "l")]
)


def check_name(name: str) -> None:
    """Raise an error if a C function must not have this name."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise InputError(f"{name!r} is no name in C; take letters, digits and underscores, beginning with a letter")
    if name in C_KEYWORDS:
        raise InputError(f"{name!r} is a keyword of C or C++; take another name, such as 'my_{name}'")
    if name in LIBRARY or _PATTERNS.fullmatch(name):
        raise InputError(f"{name!r} is a name of the C library; take another name, such as 'my_{name}'")
