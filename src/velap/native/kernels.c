/* Dense networks on a few dozen rows: the plan of one environment is some thousand such calls.

   A layer is y = x W + b; where it has a shift, y / sqrt(mean(y^2) + eps) + shift; then LeakyReLU, except in the last
   layer. Weights lie in panels of PANEL columns, [outputs / PANEL, inputs, PANEL], padded with zeros, bias and shift
   padded likewise; velap/models/native.py packs them. Blocks of ROWS rows go through all layers while they are in the
   first-level cache. The sums of a row are taken in one order whatever rows are beside it.

   Layers with `halves` multiply in bfloat16 and sum in float32, on processors that can (velap_halves): their weights lie in
   panels of pairs, [outputs / PANEL, inputs / 2, PANEL, 2], inputs padded with zeros to whole TILE_INPUTS. Where there are
   matrix tiles (velap_tiles), networks whose layers all have `halves` take blocks of TILE_ROWS rows. A layer with `lows` keeps
   the precision of its inputs there: weights and inputs are sums of two bfloat16 numbers, and only the product of the smaller
   ones is left out. */

#ifdef __AVX512F__
#include <immintrin.h>
#endif
#ifdef __AMX_BF16__
#include <sys/syscall.h>
#include <unistd.h>
#endif
#include <math.h>
#include <stddef.h>
#include <string.h>

#ifdef __AVX512F__
#define LANES 16
#define ROWS 8
#else
#define LANES 8
#define ROWS 4
#endif
#define PANEL 32
#define VECTORS (PANEL / LANES)
#define TILE_INPUTS 32 /* bfloat16 numbers in a row of a tile */
#define TILE_ROWS 32   /* two tiles of 16 */

typedef float vector __attribute__((vector_size(4 * LANES), aligned(4)));

typedef struct {
    long inputs, outputs; /* outputs: not padded */
    const float *weights, *bias, *shift; /* shift: NULL where nothing is normalised */
    const unsigned short *halves;        /* NULL where the layer is in float32 */
    const unsigned short *lows;          /* what bfloat16 weights leave of the weights; NULL where that is dropped */
} Layer;

/* Whether layers may have `halves`. */
int velap_halves(void) {
#ifdef __AVX512BF16__
    return 1;
#else
    return 0;
#endif
}

/* Whether the processor has tiles, and the kernel lends their registers to this process. */
int velap_tiles(void) {
#ifdef __AMX_BF16__
    const long request = 0x1023, tile_data = 18; /* ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA */
    return syscall(SYS_arch_prctl, request, tile_data) == 0;
#else
    return 0;
#endif
}

/* Inputs of a layer with `halves` as they are padded. */
static inline long padded_inputs(const Layer *layer) {
    return (layer->inputs + TILE_INPUTS - 1) / TILE_INPUTS * TILE_INPUTS;
}

static inline __attribute__((always_inline)) void products(const Layer *layer, const float *in, long in_stride, float *out,
                                                           long out_stride, const int rows) {
    const long panels = (layer->outputs + PANEL - 1) / PANEL;
    for (long p = 0; p < panels; p++) {
        const float *weights = layer->weights + p * layer->inputs * PANEL;
        vector sums[ROWS][VECTORS];
        for (int r = 0; r < rows; r++)
            for (int v = 0; v < VECTORS; v++) sums[r][v] = *(const vector *)(layer->bias + p * PANEL + v * LANES);
        for (long i = 0; i < layer->inputs; i++, weights += PANEL)
            for (int v = 0; v < VECTORS; v++) {
                const vector column = *(const vector *)(weights + v * LANES);
                for (int r = 0; r < rows; r++) sums[r][v] += column * in[r * in_stride + i];
            }
        for (int r = 0; r < rows; r++)
            for (int v = 0; v < VECTORS; v++) *(vector *)(out + r * out_stride + p * PANEL + v * LANES) = sums[r][v];
    }
}

#ifdef __AVX512BF16__
static inline __attribute__((always_inline)) void half_products(const Layer *layer, const unsigned short *in, long in_stride,
                                                                float *out, long out_stride, const int rows) {
    const long panels = (layer->outputs + PANEL - 1) / PANEL, pairs = (layer->inputs + 1) / 2;
    for (long p = 0; p < panels; p++) {
        const unsigned short *weights = layer->halves + p * padded_inputs(layer) * PANEL;
        __m512 sums[ROWS][VECTORS];
        for (int r = 0; r < rows; r++)
            for (int v = 0; v < VECTORS; v++) sums[r][v] = _mm512_loadu_ps(layer->bias + p * PANEL + v * LANES);
        for (long i = 0; i < pairs; i++, weights += 2 * PANEL)
            for (int v = 0; v < VECTORS; v++) {
                const __m512bh column = (__m512bh)_mm512_loadu_si512(weights + 2 * v * LANES);
                for (int r = 0; r < rows; r++) {
                    int pair;
                    memcpy(&pair, in + r * in_stride + 2 * i, sizeof pair);
                    sums[r][v] = _mm512_dpbf16_ps(sums[r][v], (__m512bh)_mm512_set1_epi32(pair), column);
                }
            }
        for (int r = 0; r < rows; r++)
            for (int v = 0; v < VECTORS; v++) _mm512_storeu_ps(out + r * out_stride + p * PANEL + v * LANES, sums[r][v]);
    }
}

/* `count` floats as bfloat16, and the padding behind them: it is 0, so an odd last input has its pair. */
static void halve(const float *x, long count, unsigned short *out) {
    for (long j = 0; j < count; j += LANES)
        _mm256_storeu_si256((__m256i *)(out + j), (__m256i)_mm512_cvtneps_pbh(_mm512_loadu_ps(x + j)));
}
#endif

static inline float total(vector x) {
#ifdef __AVX512F__
    return _mm512_reduce_add_ps((__m512)x);
#else
    float sum = 0;
    for (int l = 0; l < LANES; l++) sum += x[l];
    return sum;
#endif
}

static void activate(const Layer *layer, float *y, long stride, int rows, float eps, float leak) {
    const long padded = (layer->outputs + PANEL - 1) / PANEL * PANEL; /* the padding is 0 and stays 0 */
    float scales[TILE_ROWS]; /* all of them first: the roots of one row wait for nothing of another */
    for (int r = 0; r < rows && layer->shift; r++) {
        vector squares = {0};
        for (long j = 0; j < padded; j += LANES) {
            const vector part = *(vector *)(y + r * stride + j);
            squares += part * part;
        }
        scales[r] = 1 / sqrtf(total(squares) / layer->outputs + eps);
    }
    for (int r = 0; r < rows; r++, y += stride) {
        if (layer->shift)
            for (long j = 0; j < padded; j += LANES)
                *(vector *)(y + j) = *(vector *)(y + j) * scales[r] + *(const vector *)(layer->shift + j);
        for (long j = 0; j < padded; j++) y[j] = y[j] < 0 ? leak * y[j] : y[j];
    }
}

/* One network on a block of rows that lie `width` apart in `in`, which it overwrites; gives where the outputs lie, `in` or
   `next`. */
static float *network(const Layer *layers, long count, float *in, float *next, long width, int rows, float eps, float leak) {
#ifdef __AVX512BF16__
    unsigned short halves[ROWS * width];
#define PRODUCTS(n) \
    layer->halves ? half_products(layer, halves, width, next, width, n) : products(layer, in, width, next, width, n)
#else
#define PRODUCTS(n) products(layer, in, width, next, width, n)
#endif
    for (long l = 0; l < count; l++) {
        const Layer *layer = layers + l;
#ifdef __AVX512BF16__
        for (int r = 0; r < rows && layer->halves; r++) halve(in + r * width, layer->inputs, halves + r * width);
#endif
        switch (rows) { /* a constant number of rows keeps the sums in registers */
#define CASE(n) case n: PRODUCTS(n); break;
            CASE(1) CASE(2) CASE(3) CASE(4)
#if ROWS == 8
            CASE(5) CASE(6) CASE(7) CASE(8)
#endif
        }
        if (l + 1 < count) activate(layer, next, width, rows, eps, leak);
        float *swap = in;
        in = next;
        next = swap;
    }
    return in;
}

#ifdef __AMX_BF16__
/* Rows of a tile: 16 lines of 64 bytes in all eight of them. */
static const struct {
    unsigned char palette, start, reserved[14];
    unsigned short line_bytes[16];
    unsigned char lines[16];
} tile_shape = {1, 0, {0}, {64, 64, 64, 64, 64, 64, 64, 64}, {16, 16, 16, 16, 16, 16, 16, 16}};

/* Adds TILE_ROWS rows of `in` times one panel of weights to the tiles 0 to 3. */
static inline __attribute__((always_inline)) void tile_sums(const unsigned short *in, long stride, const unsigned short *weights,
                                                            long inputs) {
    for (long i = 0; i < inputs; i += TILE_INPUTS, weights += TILE_INPUTS * PANEL) {
        _tile_loadd(4, in + i, 2 * stride);
        _tile_loadd(5, in + 16 * stride + i, 2 * stride);
        _tile_loadd(6, weights, 4 * PANEL);
        _tile_loadd(7, weights + PANEL, 4 * PANEL);
        _tile_dpbf16ps(0, 4, 6);
        _tile_dpbf16ps(1, 4, 7);
        _tile_dpbf16ps(2, 5, 6);
        _tile_dpbf16ps(3, 5, 7);
    }
}

/* One layer without its activation on TILE_ROWS rows that lie `width` apart; `high` and `low` hold as many. */
static void tile_layer(const Layer *layer, const float *in, float *out, long width, unsigned short *high, unsigned short *low) {
    const long inputs = padded_inputs(layer);
    for (long r = 0; r < TILE_ROWS; r++)
        for (long i = 0; i < inputs; i += LANES) {
            const __m512 x = _mm512_loadu_ps(in + r * width + i);
            const __m256i half = (__m256i)_mm512_cvtneps_pbh(x);
            _mm256_storeu_si256((__m256i *)(high + r * width + i), half);
            if (!layer->lows) continue;
            const __m512 rounded = _mm512_castsi512_ps(_mm512_slli_epi32(_mm512_cvtepu16_epi32(half), 16));
            _mm256_storeu_si256((__m256i *)(low + r * width + i), (__m256i)_mm512_cvtneps_pbh(x - rounded));
        }
    for (long column = 0; column < layer->outputs; column += PANEL) {
        const float *bias = layer->bias + column;
        _tile_loadd(0, bias, 0); /* every line of the tile is the bias */
        _tile_loadd(1, bias + 16, 0);
        _tile_loadd(2, bias, 0);
        _tile_loadd(3, bias + 16, 0);
        tile_sums(high, width, layer->halves + column * inputs, inputs);
        if (layer->lows) {
            tile_sums(low, width, layer->halves + column * inputs, inputs);
            tile_sums(high, width, layer->lows + column * inputs, inputs);
        }
        _tile_stored(0, out + column, 4 * width);
        _tile_stored(1, out + column + 16, 4 * width);
        _tile_stored(2, out + 16 * width + column, 4 * width);
        _tile_stored(3, out + 16 * width + column + 16, 4 * width);
    }
}

/* velap_network by tiles. */
static void tile_network(const Layer *layers, long members, long count, const float *const *x, const long *widths, long parts,
                         long rows, long width, float eps, float leak, float *out) {
    float scratch[2 * TILE_ROWS * width];
    unsigned short high[TILE_ROWS * width], low[TILE_ROWS * width];
    _tile_loadconfig(&tile_shape);
    for (long start = 0; start < rows; start += TILE_ROWS) {
        const long block = rows - start < TILE_ROWS ? rows - start : TILE_ROWS;
        for (long m = 0; m < members; m++) {
            float *in = scratch, *next = scratch + TILE_ROWS * width;
            memset(in, 0, sizeof(float) * TILE_ROWS * width); /* padded inputs, and rows that are not there */
            for (long r = 0; r < block; r++) {
                float *row = in + r * width;
                for (long p = 0; p < parts; row += widths[p], p++)
                    memcpy(row, x[p] + (start + r) * widths[p], sizeof(float) * widths[p]);
            }
            for (const Layer *layer = layers + m * count; layer < layers + (m + 1) * count; layer++) {
                tile_layer(layer, in, next, width, high, low);
                if (layer + 1 < layers + (m + 1) * count) activate(layer, next, width, block, eps, leak);
                float *swap = in;
                in = next;
                next = swap;
            }
            const long outputs = layers[m * count + count - 1].outputs;
            for (long r = 0; r < block; r++)
                memcpy(out + (m * rows + start + r) * outputs, in + r * width, sizeof(float) * outputs);
        }
    }
    _tile_release();
}
#endif

/* x: `parts` inputs side by side, part p [rows, widths[p]]; out [members, rows, outputs]; layers [members, count];
   width: the largest padded number of units. */
void velap_network(const Layer *layers, long members, long count, const float *const *x, const long *widths, long parts,
                   long rows, long width, float eps, float leak, float *out) {
#ifdef __AMX_BF16__
    if (layers->halves) { /* the first layer has them only where velap_tiles said yes */
        tile_network(layers, members, count, x, widths, parts, rows, width, eps, leak, out);
        return;
    }
#endif
    float scratch[2 * ROWS * width];
    for (long start = 0; start < rows; start += ROWS) {
        const int block = (int)(rows - start < ROWS ? rows - start : ROWS);
        for (long m = 0; m < members; m++) {
            for (int r = 0; r < block; r++) {
                float *row = scratch + r * width;
                for (long p = 0; p < parts; row += widths[p], p++)
                    memcpy(row, x[p] + (start + r) * widths[p], sizeof(float) * widths[p]);
            }
            const float *y = network(layers + m * count, count, scratch, scratch + ROWS * width, width, block, eps, leak);
            const long outputs = layers[m * count + count - 1].outputs;
            for (int r = 0; r < block; r++)
                memcpy(out + (m * rows + start + r) * outputs, y + r * width, sizeof(float) * outputs);
        }
    }
}

/* out: z [rows, dim] after `steps` steps. Each takes the action tanh(acting(z, noise[step])) to moving(z, action), plus z
   where `residual`. noise [rows, draws, noise_dim], the last draw lasting to the end. */
void velap_rollout(const Layer *acting, long acting_count, const Layer *moving, long moving_count, const float *z,
                   const float *noise, long draws, long noise_dim, long steps, int residual, long rows, long width, float eps,
                   float leak, float *out) {
    const long actions = acting[acting_count - 1].outputs, dim = moving[moving_count - 1].outputs;
    float scratch[2 * ROWS * width], latents[ROWS * dim];
    float *const first = scratch, *const second = scratch + ROWS * width;
    for (long start = 0; start < rows; start += ROWS) {
        const int block = (int)(rows - start < ROWS ? rows - start : ROWS);
        memcpy(latents, z + start * dim, sizeof(float) * block * dim);
        for (long step = 0; step < steps; step++) {
            const long draw = step < draws ? step : draws - 1;
            for (int r = 0; r < block; r++) {
                memcpy(first + r * width, latents + r * dim, sizeof(float) * dim);
                memcpy(first + r * width + dim, noise + ((start + r) * draws + draw) * noise_dim, sizeof(float) * noise_dim);
            }
            const float *acts = network(acting, acting_count, first, second, width, block, eps, leak);
            float *in = acts == first ? second : first, *next = acts == first ? first : second;
            for (int r = 0; r < block; r++) {
                memcpy(in + r * width, latents + r * dim, sizeof(float) * dim);
                for (long a = 0; a < actions; a++) in[r * width + dim + a] = tanhf(acts[r * width + a]);
            }
            const float *change = network(moving, moving_count, in, next, width, block, eps, leak);
            for (int r = 0; r < block; r++)
                for (long d = 0; d < dim; d++)
                    latents[r * dim + d] = change[r * width + d] + (residual ? latents[r * dim + d] : 0);
        }
        memcpy(out + start * dim, latents, sizeof(float) * block * dim);
    }
}
