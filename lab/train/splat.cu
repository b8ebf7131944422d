// The splatter of train_gpu.py: one thread for each pixel of a tile of 8 x 8, over the tile's splats from front to back. With HOST defined it compiles as
// C++, for the comparison with plain PyTorch on machines without a GPU.
//
// A splat is nine floats: place u v, inverse covariance a b c, opacity, colour r g b.

#define TILE 8
#define WIDTH 9
#define ALPHA_MAX 0.99f
#define ALPHA_MIN (1.0f / 16384)
#define T_MIN 1e-4f

#ifdef HOST
#include <cmath>
#define DEVICE static inline
#define any(x) (x)
static inline void add(float *to, float value, bool on) { if (on) *to += value; }
#else
#define DEVICE __device__ __forceinline__
#define any(x) __any_sync(0xffffffffu, x)
// The sum over a warp; lanes that are not `on` bring zero.
__device__ __forceinline__ void add(float *to, float value, bool on) {
    value = on ? value : 0.0f;
    for (int i = 16; i; i >>= 1) value += __shfl_down_sync(0xffffffffu, value, i);
    if ((threadIdx.x & 31) == 0) atomicAdd(to, value);
}
#endif

struct Pixel {
    int at, begin, end;
    float x, y;
    bool inside;
};

DEVICE Pixel pixel_of(const int *ranges, int tiles_x, int tiles_y, int width, int height, int block, int thread) {
    int view = block / (tiles_x * tiles_y), tile = block % (tiles_x * tiles_y);
    int x = tile % tiles_x * TILE + thread % TILE, y = tile / tiles_x * TILE + thread / TILE;
    Pixel p;
    p.inside = x < width && y < height;
    p.at = (view * height + y) * width + x;
    p.begin = ranges[block], p.end = ranges[block + 1];
    p.x = x + 0.5f, p.y = y + 0.5f;
    return p;
}

DEVICE float alpha_of(const float *s, float dx, float dy, float *gauss) {
    float power = -0.5f * (s[2] * dx * dx + s[4] * dy * dy) - s[3] * dx * dy;
    *gauss = expf(fminf(power, 0.0f));
    return fminf(s[5] * *gauss, ALPHA_MAX);
}

DEVICE void forward_pixel(const float *splats, const int *order, const int *ranges, const float *background, float *image, int tiles_x, int tiles_y, int width,
                          int height, int block, int thread) {
    Pixel p = pixel_of(ranges, tiles_x, tiles_y, width, height, block, thread);
    if (!p.inside) return;
    float t = 1, left = 1, colour[3] = {0, 0, 0}, gauss;
    for (int i = p.begin; i < p.end && t >= T_MIN; ++i) {
        const float *s = splats + (long long)order[i] * WIDTH;
        float alpha = alpha_of(s, p.x - s[0], p.y - s[1], &gauss);
        if (alpha < ALPHA_MIN) continue;
        float w = alpha * t;
        for (int c = 0; c < 3; ++c) colour[c] += w * s[6 + c];
        left -= w;
        t *= 1 - alpha;
    }
    const float *b = background + block / (tiles_x * tiles_y) * 3;
    for (int c = 0; c < 3; ++c) image[p.at * 3 + c] = colour[c] + left * b[c];
}

DEVICE void backward_pixel(const float *splats, const int *order, const int *ranges, const float *image, const float *dimage, float *grad, 
                           int tiles_x, int tiles_y, int width, int height, int block, int thread) {
    Pixel p = pixel_of(ranges, tiles_x, tiles_y, width, height, block, thread);
    float t = 1, g[3] = {0, 0, 0}, rest = 0;
    if (p.inside)
        for (int c = 0; c < 3; ++c) {
            g[c] = dimage[p.at * 3 + c];
            rest += g[c] * image[p.at * 3 + c];
        }
    for (int i = p.begin; i < p.end; ++i) {
        bool on = p.inside && t >= T_MIN;
        if (!any(on)) break;
        const float *s = splats + (long long)order[i] * WIDTH;
        float dx = p.x - s[0], dy = p.y - s[1], gauss = 0, alpha = alpha_of(s, dx, dy, &gauss);
        on = on && alpha >= ALPHA_MIN;
        if (!any(on)) continue;
        float w = alpha * t, own = g[0] * s[6] + g[1] * s[7] + g[2] * s[8];
        float dalpha = 0;
        if (on) {
            // What lies behind: the rest of the pixel, with the background seen past everything drawn.
            rest -= w * own;
            dalpha = t * own - rest / (1 - alpha);
            t *= 1 - alpha;
        }
        bool free = on && s[5] * gauss < ALPHA_MAX;
        float dpower = free ? dalpha * alpha : 0;
        float *d = grad + (long long)order[i] * WIDTH;
        for (int c = 0; c < 3; ++c) add(d + 6 + c, w * g[c], on);
        if (!any(free)) continue;
        add(d + 0, dpower * (s[2] * dx + s[3] * dy), free);
        add(d + 1, dpower * (s[4] * dy + s[3] * dx), free);
        add(d + 2, -0.5f * dx * dx * dpower, free);
        add(d + 3, -dx * dy * dpower, free);
        add(d + 4, -0.5f * dy * dy * dpower, free);
        add(d + 5, dalpha * gauss, free);
    }
}

#ifdef HOST
extern "C" void forward(int blocks, const float *splats, const int *order, const int *ranges, const float *background, float *image, int tiles_x, int tiles_y,
                        int width, int height) {
    for (int b = 0; b < blocks; ++b)
        for (int t = 0; t < TILE * TILE; ++t) forward_pixel(splats, order, ranges, background, image, tiles_x, tiles_y, width, height, b, t);
}
extern "C" void backward(int blocks, const float *splats, const int *order, const int *ranges, const float *image, const float *dimage,
                         float *grad, int tiles_x, int tiles_y, int width, int height) {
    for (int b = 0; b < blocks; ++b)
        for (int t = 0; t < TILE * TILE; ++t) backward_pixel(splats, order, ranges, image, dimage, grad, tiles_x, tiles_y, width, height, b, t);
}
#else
extern "C" __global__ void forward(const float *splats, const int *order, const int *ranges, const float *background, float *image, int tiles_x, int tiles_y,
                                   int width, int height) {
    forward_pixel(splats, order, ranges, background, image, tiles_x, tiles_y, width, height, blockIdx.x, threadIdx.x);
}
extern "C" __global__ void backward(const float *splats, const int *order, const int *ranges, const float *image, const float *dimage,
                                    float *grad, int tiles_x, int tiles_y, int width, int height) {
    backward_pixel(splats, order, ranges, image, dimage, grad, tiles_x, tiles_y, width, height, blockIdx.x, threadIdx.x);
}
#endif
