/* Dense networks in float32 for one input: x -> relu(x A_1) -> ... -> x A_n.

   The twin is networks/learned_networks.py, whose products are NumPy's, and so those of its BLAS. Another order of sums
   changes the last bits. So each product is either a call of that BLAS, or `sparse_product`, which adds in the order of
   OpenBLAS' AVX2 kernels but skips inputs of 0: after a ReLU most are. Which of them has the bits of NumPy's is found
   out before the first use (networks/compiled.py). */

enum { MOST_INPUTS = 4096, BLOCK = 8, ROW_MAJOR = 101, TRANSPOSED = 112 };

typedef void features_function(const double *, const double *, double *);
typedef void gemv_64(int, int, int64_t, int64_t, float, const float *, int64_t, const float *, int64_t, float, float *,
                     int64_t);
typedef void gemv_32(int, int, int, int, float, const float *, int, const float *, int, float, float *, int);

/* y (columns,) = x (rows,) a (rows, columns), then relu over `cut` numbers from `first` on. */
typedef struct {
    const float *a, *x;
    float *y, *first;
    int rows, columns, cut, sparse;
} network_product;

#if defined(__x86_64__) && defined(__GNUC__)
#include <immintrin.h>

static int has_sparse_product(void) { return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"); }

#define AVX2 __attribute__((target("avx2,fma")))
#define EIGHT(address) _mm256_loadu_ps(address)

/* The inputs of each block of 8 that are not 0. Returns the number of blocks that have some. */
static int used_inputs(const network_product *p, int whole, int *used, int *begins)
{
    int count = 0, blocks = 0;
    for (int start = 0; start < whole; start += BLOCK) {
        const int before = count;
        for (int i = start; i < start + BLOCK; i++) {
            used[count] = i;
            count += p->x[i] != 0.0f;
        }
        if (count > before)
            begins[blocks++] = before;
    }
    begins[blocks] = count;
    return blocks;
}

/* Adds one block to `width` times 8 columns, in one chain of products. */
AVX2 static inline __attribute__((always_inline)) void add_block(
    const network_product *p, const int *used, int count, int column, const int width)
{
    __m256 sum[8];
#pragma GCC unroll 8
    for (int i = 0; i < width; i++)
        sum[i] = _mm256_setzero_ps();
    for (int k = 0; k < count; k++) {
        const float *row = p->a + (size_t)used[k] * (size_t)p->columns + column;
        const __m256 x = _mm256_broadcast_ss(p->x + used[k]);
#pragma GCC unroll 8
        for (int i = 0; i < width; i++)
            sum[i] = _mm256_fmadd_ps(EIGHT(row + 8 * i), x, sum[i]);
    }
#pragma GCC unroll 8
    for (int i = 0; i < width; i++)
        _mm256_storeu_ps(p->y + column + 8 * i, _mm256_add_ps(EIGHT(p->y + column + 8 * i), sum[i]));
}

/* Up to 8 of the columns that 16 does not divide: of each block two chains, of even and of odd inputs. */
AVX2 static void add_few(const network_product *p, const int *used, const int *begins, int blocks, int column, int count)
{
    const __m256i mask = _mm256_cmpgt_epi32(_mm256_set1_epi32(count), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7));
    __m256 total = _mm256_setzero_ps();
    for (int block = 0; block < blocks; block++) {
        __m256 even = _mm256_setzero_ps(), odd = _mm256_setzero_ps();
        for (int k = begins[block]; k < begins[block + 1]; k++) {
            const __m256 a = _mm256_maskload_ps(p->a + (size_t)used[k] * (size_t)p->columns + column, mask);
            const float x = p->x[used[k]]; /* a product with 0 changes no sum */
            even = _mm256_fmadd_ps(a, _mm256_set1_ps(used[k] & 1 ? 0.0f : x), even);
            odd = _mm256_fmadd_ps(a, _mm256_set1_ps(used[k] & 1 ? x : 0.0f), odd);
        }
        total = _mm256_add_ps(total, _mm256_add_ps(even, odd));
    }
    _mm256_maskstore_ps(p->y + column, mask, total);
}

/* The columns that 4 does not divide: one chain over all inputs. */
AVX2 static void add_last_columns(const network_product *p, const int *used, int count, int column)
{
    const __m128i mask = _mm_cmpgt_epi32(_mm_set1_epi32(p->columns - column), _mm_setr_epi32(0, 1, 2, 3));
    __m128 total = _mm_setzero_ps();
    for (int k = 0; k < count; k++)
        total = _mm_fmadd_ps(_mm_maskload_ps(p->a + (size_t)used[k] * (size_t)p->columns + column, mask),
                             _mm_broadcast_ss(p->x + used[k]), total);
    _mm_maskstore_ps(p->y + column, mask, total);
}

/* The rows after the last block: four in one chain, then two and one each by itself. */
AVX2 static void add_last_rows(const network_product *p, int whole, int columns)
{
    int row = whole;
    if ((p->rows - whole) & 4) {
        for (int column = 0; column < columns; column += 8) {
            __m256 sum = _mm256_setzero_ps();
            for (int i = row; i < row + 4; i++)
                sum = _mm256_fmadd_ps(
                    EIGHT(p->a + (size_t)i * (size_t)p->columns + column), _mm256_broadcast_ss(p->x + i), sum);
            _mm256_storeu_ps(p->y + column, _mm256_add_ps(EIGHT(p->y + column), sum));
        }
        row += 4;
    }
    for (; row < p->rows; row++)
        for (int column = 0; column < columns; column++)
            p->y[column] += p->a[(size_t)row * (size_t)p->columns + column] * p->x[row];
}

AVX2 static void sparse_product(const network_product *p)
{
    int used[MOST_INPUTS + BLOCK], begins[MOST_INPUTS / BLOCK + 1], column = 0;
    const int whole = p->rows & ~(BLOCK - 1), most = p->columns & ~3;
    const int blocks = used_inputs(p, whole, used, begins);
    memset(p->y, 0, sizeof(float) * (size_t)p->columns);
    for (int few = 4; few <= 8; few += 4)
        if (most & few) {
            add_few(p, used, begins, blocks, column, few);
            column += few;
        }
    for (int block = 0; block < blocks; block++) {
        const int *own = used + begins[block], count = begins[block + 1] - begins[block];
        int place = column;
        for (; place + 64 <= most; place += 64)
            add_block(p, own, count, place, 8);
        for (; place < most; place += 16)
            add_block(p, own, count, place, 2);
    }
    if (most < p->columns)
        add_last_columns(p, used, begins[blocks], most);
    if (whole < p->rows)
        add_last_rows(p, whole, p->columns & ~7);
}

AVX2 static void cut_below_zero(float *values, int count)
{
    int i = 0;
    for (; i + 8 <= count; i += 8) /* a NaN is the second operand, and stays */
        _mm256_storeu_ps(values + i, _mm256_max_ps(_mm256_setzero_ps(), EIGHT(values + i)));
    for (; i < count; i++)
        values[i] = values[i] < 0.0f ? 0.0f : values[i];
}
#else
static int has_sparse_product(void) { return 0; }
static void sparse_product(const network_product *p) { (void)p; }
static void cut_below_zero(float *values, int count)
{
    for (int i = 0; i < count; i++)
        values[i] = values[i] < 0.0f ? 0.0f : values[i];
}
#endif

static void multiply(const network_product *p, void *gemv, int wide)
{
    if (p->sparse)
        sparse_product(p);
    else if (wide)
        ((gemv_64 *)gemv)(ROW_MAJOR, TRANSPOSED, p->rows, p->columns, 1.0f, p->a, p->columns, p->x, 1, 0.0f, p->y, 1);
    else
        ((gemv_32 *)gemv)(ROW_MAJOR, TRANSPOSED, p->rows, p->columns, 1.0f, p->a, p->columns, p->x, 1, 0.0f, p->y, 1);
    if (p->cut && has_sparse_product())
        cut_below_zero(p->first, p->cut);
    else
        for (int i = 0; i < p->cut; i++)
            p->first[i] = p->first[i] < 0.0f ? 0.0f : p->first[i];
}
