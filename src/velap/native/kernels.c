/* Dense networks on a few dozen rows: the plan of one environment is some thousand such calls.

   A layer is y = x W + b; where it has a shift, y / sqrt(mean(y^2) + eps) + shift; then LeakyReLU, except in the last
   layer. Weights lie in panels of PANEL columns, [outputs / PANEL, inputs, PANEL], padded with zeros, bias and shift
   padded likewise; velap/native/kernels.py packs them. Blocks of ROWS rows go through all layers while they are in the
   first-level cache. The sums of a row are taken in one order whatever rows are beside it. */

#ifdef __AVX512F__
#include <immintrin.h>
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

typedef float vector __attribute__((vector_size(4 * LANES), aligned(4)));

typedef struct {
    long inputs, outputs; /* outputs: not padded */
    const float *weights, *bias, *shift; /* shift: NULL where nothing is normalised */
} Layer;

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
    float scales[ROWS]; /* all of them first: the roots of one row wait for nothing of another */
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
    for (long l = 0; l < count; l++) {
        const Layer *layer = layers + l;
        switch (rows) { /* a constant number of rows keeps the sums in registers */
#define CASE(n) case n: products(layer, in, width, next, width, n); break;
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

/* x: `parts` inputs side by side, part p [rows, widths[p]]; out [members, rows, outputs]; layers [members, count];
   width: the largest padded number of units. */
void velap_network(const Layer *layers, long members, long count, const float *const *x, const long *widths, long parts,
                   long rows, long width, float eps, float leak, float *out) {
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
