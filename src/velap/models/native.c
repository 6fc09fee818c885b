/* Dense networks on a few dozen rows: the plan of one environment is some thousand such calls.

   A layer is y = x W + b; where it has a shift, y / sqrt(mean(y^2) + eps) + shift; then LeakyReLU, except in the last
   layer. Weights lie in panels of PANEL columns, [outputs / PANEL, inputs, PANEL], padded with zeros, bias and shift
   padded likewise; velap/models/native.py packs them. Blocks of ROWS rows go through all layers while they are in the
   first-level cache. The sums of a row are taken in one order whatever rows are beside it. */

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

static void activate(const Layer *layer, float *y, float eps, float leak) {
    const long padded = (layer->outputs + PANEL - 1) / PANEL * PANEL; /* the padding is 0 and stays 0 */
    if (layer->shift) {
        vector squares = {0};
        for (long j = 0; j < padded; j += LANES) squares += *(vector *)(y + j) * *(vector *)(y + j);
        float sum = 0;
        for (int l = 0; l < LANES; l++) sum += squares[l];
        const float scale = 1 / sqrtf(sum / layer->outputs + eps);
        for (long j = 0; j < padded; j += LANES)
            *(vector *)(y + j) = *(vector *)(y + j) * scale + *(const vector *)(layer->shift + j);
    }
    for (long j = 0; j < padded; j++) y[j] = y[j] < 0 ? leak * y[j] : y[j];
}

/* x: `parts` inputs side by side, part p [rows, widths[p]]; out [members, rows, outputs]; layers [members, count];
   width: the largest padded number of units. */
void velap_network(const Layer *layers, long members, long count, const float *const *x, const long *widths, long parts,
                   long rows, long width, float eps, float leak, float *out) {
    float scratch[2 * ROWS * width];
    for (long start = 0; start < rows; start += ROWS) {
        const int block = (int)(rows - start < ROWS ? rows - start : ROWS);
        for (long m = 0; m < members; m++) {
            float *in = scratch, *next = scratch + ROWS * width;
            for (int r = 0; r < block; r++) {
                float *row = in + r * width;
                for (long p = 0; p < parts; row += widths[p], p++)
                    memcpy(row, x[p] + (start + r) * widths[p], sizeof(float) * widths[p]);
            }
            for (long l = 0; l < count; l++) {
                const Layer *layer = layers + m * count + l;
                switch (block) { /* a constant number of rows keeps the sums in registers */
#define CASE(n) case n: products(layer, in, width, next, width, n); break;
                    CASE(1) CASE(2) CASE(3) CASE(4)
#if ROWS == 8
                    CASE(5) CASE(6) CASE(7) CASE(8)
#endif
                }
                if (l + 1 < count)
                    for (int r = 0; r < block; r++) activate(layer, next + r * width, eps, leak);
                float *swap = in;
                in = next;
                next = swap;
            }
            const long outputs = layers[m * count + count - 1].outputs;
            for (int r = 0; r < block; r++)
                memcpy(out + (m * rows + start + r) * outputs, in + r * width, sizeof(float) * outputs);
        }
    }
}
