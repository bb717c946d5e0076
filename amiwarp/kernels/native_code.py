"""Native code for what Warp's language lacks: unstrided loads and stores, and additions to pairs of elements.

With them, CPU compilers vectorise a loop.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("return ((const uint16_t*)values.data)[i];")
def load_uint16(values: wp.array(dtype=wp.uint16), i: int) -> wp.uint16:
    """Load element ``i`` of a contiguous array of uint16."""


@wp.func_native("return ((const uint8_t*)values.data)[i];")
def load_uint8(values: wp.array(dtype=wp.uint8), i: int) -> wp.uint8:
    """Load element ``i`` of a contiguous array of uint8."""


@wp.func_native("return ((const uint32_t*)values.data)[i];")
def load_uint32(values: wp.array(dtype=wp.uint32), i: int) -> wp.uint32:
    """Load element ``i`` of a contiguous array of uint32."""


@wp.func_native("return ((const int32_t*)values.data)[i];")
def load_int(values: wp.array(dtype=int), i: int) -> int:
    """Load element ``i`` of a contiguous array of int32."""


@wp.func_native("return ((const volatile int32_t*)values.data)[i];")
def load_one_int(values: wp.array(dtype=int), i: int) -> int:
    """Load element ``i`` by an instruction for it alone. Compilers make one of several loads, which CPUs run slowly."""


@wp.func_native("return ((const volatile float*)values.data)[i];")
def load_one_float(values: wp.array(dtype=float), i: int) -> float:
    """Load element ``i`` by an instruction for it alone, as :func:`load_one_int` does."""


@wp.func_native("return ((const int64_t*)values.data)[i];")
def load_int64(values: wp.array(dtype=wp.int64), i: int) -> wp.int64:
    """Load element ``i`` of a contiguous array of int64."""


@wp.func_native("return ((const float*)values.data)[i];")
def load_float(values: wp.array(dtype=float), i: int) -> float:
    """Load element ``i`` of a contiguous array of float32."""


@wp.func_native("return ((const uint64_t*)values.data)[i];")
def load_word(values: wp.array(dtype=wp.uint64), i: int) -> wp.uint64:
    """Load element ``i`` of a contiguous array of uint64."""


@wp.func_native("((int64_t*)values.data)[i] = value;")
def store_int64(values: wp.array(dtype=wp.int64), i: int, value: wp.int64):
    """Store ``value`` as element ``i`` of a contiguous array of int64."""


@wp.func_native("((float*)values.data)[i] = value;")
def store_float(values: wp.array(dtype=float), i: int, value: float):
    """Store ``value`` as element ``i`` of a contiguous array of float32."""


@wp.func_native("((uint8_t*)values.data)[i] = (uint8_t)value;")
def store_uint8(values: wp.array(dtype=wp.uint8), i: int, value: int):
    """Store ``value`` as element ``i`` of a contiguous array of uint8."""


@wp.func_native("((uint16_t*)values.data)[i] = (uint16_t)value;")
def store_uint16(values: wp.array(dtype=wp.uint16), i: int, value: int):
    """Store ``value`` as element ``i`` of a contiguous array of uint16."""


@wp.func_native("((uint32_t*)values.data)[i] = value;")
def store_uint32(values: wp.array(dtype=wp.uint32), i: int, value: wp.uint32):
    """Store ``value`` as element ``i`` of a contiguous array of uint32."""


@wp.func_native("((int32_t*)values.data)[i] = value;")
def store_int(values: wp.array(dtype=int), i: int, value: int):
    """Store ``value`` as element ``i`` of a contiguous array of int32."""


@wp.func_native(
    "for (int k = 0; k < n; ++k) ((float*)out.data)[k] = ((const float*)values.data)[first + k];"
)
def copy_floats(out: wp.array(dtype=float), values: wp.array(dtype=float), first: int, n: int):
    """Copy ``values[first : first + n]`` of contiguous arrays of float32."""


@wp.func_native(
    "for (int k = 0; k < n; ++k) ((uint8_t*)out.data)[k] = ((const uint8_t*)values.data)[first + k];"
)
def copy_bytes(out: wp.array(dtype=wp.uint8), values: wp.array(dtype=wp.uint8), first: int, n: int):
    """Copy ``values[first : first + n]`` of contiguous arrays of uint8."""


@wp.func_native(
    "for (int k = 0; k < n; ++k) ((int64_t*)out.data)[k] = ((const int64_t*)values.data)[first + k];"
)
def copy_int64s(
    out: wp.array(dtype=wp.int64), values: wp.array(dtype=wp.int64), first: int, n: int
):
    """Copy ``values[first : first + n]`` of contiguous arrays of int64."""


@wp.func_native("""
    const int64_t* value = (const int64_t*)values.data;
    int fall = 0;
    for (int k = first; k < stop; ++k) fall |= value[k] < value[k - 1];
    return fall;
""")
def descends(values: wp.array(dtype=wp.int64), first: int, stop: int) -> bool:
    """Return whether any of ``values[first : stop]`` is less than the value before it."""


@wp.func_native("""
    const uint16_t* value = (const uint16_t*)values.data;
    uint16_t most = 0;
    for (int k = first; k < stop; ++k) most = value[k] > most ? value[k] : most;
    return most;
""")
def largest_of(values: wp.array(dtype=wp.uint16), first: int, stop: int) -> int:
    """Return the largest of ``values[first : stop]``, or 0 if there are none."""


@wp.func_native("""
    typedef uint64_t eight __attribute__((vector_size(64)));
    const uint64_t* t = (const uint64_t*)pairs.data;
    const uint16_t* i = (const uint16_t*)indices.data + first;
    for (int k = 0; k < 64; k += 8, i += 8) {
        const eight some = {t[i[0]], t[i[1]], t[i[2]], t[i[3]], t[i[4]], t[i[5]], t[i[6]], t[i[7]]};
        memcpy((uint64_t*)out.data + k, &some, 64);
    }
""")
def load_pairs(
    out: wp.array(dtype=float),
    pairs: wp.array(dtype=float),
    indices: wp.array(dtype=wp.uint16),
    first: int,
):
    """Copy the pairs of floats at ``indices[first : first + 64]`` of a table of pairs, one load each. For CPUs.

    Eight are stored at once, because a vector load from several waiting stores would wait until they are in the cache.
    """


@wp.func_native("""
    const int* place = (const int*)places.data;
    const uint64_t* share = (const uint64_t*)shares.data;
    uint32_t* sum = (uint32_t*)sums.data;
#ifndef __CUDACC__
    for (int k = 0; k < n; ++k) __builtin_prefetch(sum + place[k] + columns, 1);
#endif
#pragma clang loop unroll(disable)
    for (int k = 0; k < n; ++k) {
        uint64_t above, below;
        uint32_t* at = sum + place[k];
        memcpy(&above, at, 8);
        memcpy(&below, at + columns, 8);
        above += share[2 * k];
        below += share[2 * k + 1];
        memcpy(at, &above, 8);
        memcpy(at + columns, &below, 8);
    }
""")
def add_word_pairs(
    sums: wp.array(dtype=int),
    places: wp.array(dtype=int),
    shares: wp.array(dtype=int),
    columns: int,
    n: int,
):
    """Add four shares to the 2 x 2 elements at each of ``n`` places of an image, two in one 64-bit addition.

    Only for little-endian CPUs, if no sum overflows 32 bits and no other thread writes to the image. The elements are
    prefetched, because an image is larger than a core's cache. The loop of additions is not unrolled: with more loads
    and stores, the same code took up to twice as long at some addresses on an AMD EPYC.
    """


@wp.func_native("""
#ifndef __CUDACC__
    for (int k = 0; k < 512; k += 64) __builtin_prefetch((const char*)t.data + 8 * (int64_t)first + k);
    for (int k = 0; k < 128; k += 64) __builtin_prefetch((const char*)x.data + 2 * (int64_t)first + k);
    for (int k = 0; k < 128; k += 64) __builtin_prefetch((const char*)y.data + 2 * (int64_t)first + k);
    __builtin_prefetch((const char*)p.data + (int64_t)first);
#endif
""")
def prefetch_events(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    p: wp.array(dtype=wp.uint8),
    first: int,
):
    """Fetch the columns of 64 events into a core's cache, while it goes on."""


@wp.func_native("""
#ifndef __CUDACC__
    for (int k = 0; k < n; ++k) __builtin_prefetch((uint64_t*)sums.data + ((const int*)places.data)[first + k], 1);
#endif
""")
def prefetch_words(sums: wp.array(dtype=wp.int64), places: wp.array(dtype=int), first: int, n: int):
    """Fetch the words at ``places[first : first + n]`` into a core's cache, while it goes on."""


@wp.func_native("""
#ifndef __CUDACC__
    __builtin_prefetch((const int32_t*)values.data + i, 1);
#endif
""")
def prefetch_int(values: wp.array(dtype=int), i: int):
    """Fetch element ``i`` into a core's cache, while it goes on."""


@wp.func_native("""
#ifndef __CUDACC__
    __builtin_prefetch((const float*)values.data + i);
#endif
""")
def prefetch_float(values: wp.array(dtype=float), i: int):
    """Fetch element ``i`` into a core's cache, while it goes on."""


@wp.func_native("""
    const int* place = (const int*)places.data + first;
    const uint64_t* word = (const uint64_t*)words.data + first;
    uint64_t* sum = (uint64_t*)sums.data;
#pragma clang loop unroll(disable)
    for (int k = 0; k < n; ++k) sum[place[k]] += word[k];
""")
def add_words(
    sums: wp.array(dtype=wp.int64),
    places: wp.array(dtype=int),
    words: wp.array(dtype=wp.int64),
    first: int,
    n: int,
):
    """Add ``words[first : first + n]`` at their places, modulo 2**64. For CPUs, if no other thread adds there."""


_HALVES = """
    const int above = 64 - low, fraction = 2 * low - 64;
    const double unit = 1.0 / (double)(1 << fraction);
    const auto end_of = [above](uint64_t word) { return (int64_t)(word << above) >> above; };
    const auto start_of = [=](uint64_t word) {
        const int64_t end = end_of(word);
        return ((int64_t)(word - (uint64_t)end) >> low) * (1 << fraction) - end;
    };
"""
"""The shares of a time interval's start and end that a word of :mod:`amiwarp.kernels.tensors` holds, in ``unit``."""


@wp.func_native(
    _HALVES
    + """
#ifdef __CUDACC__
    const int most = 1;
#else
    const int most = 64;
#endif
    int64_t total[most];
    for (int bin = bins - 1; bin >= 0; --bin) {
        uint64_t* starts = (uint64_t*)words.data + start + bin * parts * size;
        const uint64_t* ends = starts - parts * size;
        for (int first = 0; first < n; first += most) {
            const int m = n - first < most ? n - first : most;
            float* to = (float*)out.data + at + bin * size + first;
            for (int k = 0; k < m; ++k) total[k] = 0;
            for (int part = 0; part < (bin < steps ? parts : 0); ++part)
                for (int k = 0; k < m; ++k) total[k] += start_of(starts[part * size + first + k]);
            for (int part = 0; part < (bin > 0 ? parts : 0); ++part)
                for (int k = 0; k < m; ++k) total[k] += end_of(ends[part * size + first + k]);
            for (int k = 0; k < m; ++k) to[k] = (float)((double)total[k] * unit);
        }
#ifndef __CUDACC__
        for (int part = 0; part < (bin < steps ? parts : 0); ++part) memset(starts + part * size, 0, 8 * n);
#endif
    }
"""
)
def read_words(
    out: wp.array(dtype=float),
    at: int,
    words: wp.array(dtype=wp.int64),
    low: int,
    start: int,
    size: int,
    steps: int,
    parts: int,
    bins: int,
    n: int,
):
    """Compute all bins of ``n`` pixels of a voxel grid from the words of :mod:`amiwarp.kernels.tensors`.

    ``low`` is the number of bits of the lower field, ``size`` the number of pixels of an image, ``parts`` the number of
    images of a time interval. On CPUs, the words are cleared.
    """


@wp.func_native("""
#ifndef __CUDACC__
    const uint64_t* pair = (const uint64_t*)words.data;
    const int* pixel = (const int*)pixels.data + first;
    const float* bin = (const float*)out.data + at;
    for (int k = 0; k < n; ++k) {
        __builtin_prefetch(pair + 2 * pixel[k], 1);
        __builtin_prefetch(bin + pixel[k], 1);
        __builtin_prefetch(bin + size + pixel[k], 1);
    }
#endif
""")
def prefetch_bins(
    out: wp.array(dtype=float),
    at: int,
    size: int,
    words: wp.array(dtype=wp.int64),
    pixels: wp.array(dtype=int),
    first: int,
    n: int,
):
    """Fetch what :func:`add_to_bins` changes into a core's cache, while it goes on."""


@wp.func_native(
    _HALVES
    + """
    const int* pixel = (const int*)pixels.data + first;
    const uint64_t* word = (const uint64_t*)added.data + first;
    float* bin = (float*)out.data + at;
    for (int k = 0; k < n; ++k) {
        uint64_t* pair = (uint64_t*)words.data + 2 * pixel[k];
        const uint64_t sum = pair[this_word] += word[k];
        const int64_t total = start_of(sum) + end_of(pair[1 - this_word]);
        bin[pixel[k]] = (float)((double)total * unit);
        if (size) bin[size + pixel[k]] = (float)((double)end_of(sum) * unit);
    }
"""
)
def add_to_bins(
    out: wp.array(dtype=float),
    at: int,
    size: int,
    words: wp.array(dtype=wp.int64),
    low: int,
    this_word: int,
    pixels: wp.array(dtype=int),
    added: wp.array(dtype=wp.int64),
    first: int,
    n: int,
):
    """Add the words of ``n`` events of a time interval, and write what is known of both its bins. For CPUs.

    A pixel has two words: number ``this_word`` of this interval, the other one of the interval before. ``at``: first
    element of the bin at the interval's start; the bin at its end is ``size`` further, 0 if there is none. The last
    event of a pixel leaves the right value; at the end, unless the next interval has one there.
    """


@wp.func_native("""
    const int* pixel = (const int*)pixels.data;
    uint64_t* pair = (uint64_t*)words.data;
    for (int k = 0; k < n; ++k) pair[2 * pixel[k] + of_pair] = 0;
""")
def clear_words(words: wp.array(dtype=wp.int64), of_pair: int, pixels: wp.array(dtype=int), n: int):
    """Set one of the two words of ``n`` pixels to 0. For CPUs."""


@wp.func_native("""
    int64_t* element = (int64_t*)values.data;
    const int n = values.shape[0];
    for (int k = 0; k < n; ++k) element[k] = value;
""")
def fill_int64s(values: wp.array(dtype=wp.int64), value: wp.int64):
    """Set all elements of a contiguous array of int64."""


@wp.func_native("""
    typedef int64_t several __attribute__((vector_size(32), aligned(8)));
    const int* place = (const int*)places.data;
    const int64_t* share = (const int64_t*)shares.data;
    int64_t* sum = (int64_t*)sums.data;
#ifndef __CUDACC__
    for (int k = 0; k < n; ++k) {
        __builtin_prefetch(sum + place[k], 1);
        __builtin_prefetch(sum + place[k] + stride, 1);
    }
#endif
#pragma clang loop unroll(disable)
    for (int k = 0; k < n; ++k) {
        several *above = (several*)(sum + place[k]), *below = (several*)(sum + place[k] + stride);
        *above += *(const several*)(share + 8 * k);
        *below += *(const several*)(share + 8 * k + 4);
    }
""")
def add_squares(
    sums: wp.array(dtype=wp.int64),
    places: wp.array(dtype=int),
    shares: wp.array(dtype=wp.int64),
    stride: int,
    n: int,
):
    """Add four shares to the sums at each of ``n`` places, and four more ``stride`` sums further. For CPUs."""


@wp.func_native("""
    const int* place = (const int*)places.data;
    int* sum = (int*)sums.data;
#ifndef __CUDACC__
    for (int k = 0; k < n; ++k) __builtin_prefetch(sum + place[k], 1);
#endif
#pragma clang loop unroll(disable)
    for (int k = 0; k < n; ++k) ++sum[place[k]];
""")
def count_places(sums: wp.array(dtype=int), places: wp.array(dtype=int), n: int):
    """Add 1 to the count at each of ``n`` places. For CPUs, if no other thread adds there."""
