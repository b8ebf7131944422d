/* Decodes a stream as it is read, and draws its finest level as a PPM picture.
 *
 *     cargo build --release -p b2p-capi
 *     cc capi/examples/decode.c -I capi/include target/release/libb2p_c.a -lpthread -ldl -lm -o decode
 *     ./decode models/scene.b2p scene.ppm
 */
#include <stdio.h>
#include <stdlib.h>

#include "b2p.h"

static char message[256];

/* Ends the program with the library's message if a call failed. */
static void check(b2p_status status) {
    if (status != B2P_STATUS_OK) {
        fprintf(stderr, "status %d: %s\n", (int)status, message);
        exit(1);
    }
}

static FILE *open_file(const char *path, const char *mode) {
    FILE *file = fopen(path, mode);
    if (file == NULL) {
        perror(path);
        exit(1);
    }
    return file;
}

int main(int count, char **arguments) {
    if (count != 3) {
        fprintf(stderr, "usage: decode STREAM.b2p PICTURE.ppm\n");
        return 2;
    }
    /* No model: surfels. The default limits. The finest level. */
    b2p_decoding *decoding = NULL;
    check(b2p_decoding_start(NULL, NULL, NULL, -1, &decoding, message, sizeof message));
    FILE *stream = open_file(arguments[1], "rb");
    uint8_t piece[4096];
    size_t length;
    while ((length = fread(piece, 1, sizeof piece, stream)) > 0) {
        check(b2p_decoding_push(decoding, piece, length, message, sizeof message));
        int32_t level;
        do {
            check(b2p_decoding_advance(decoding, &level, message, sizeof message));
            if (level >= 0) {
                printf("level %d is complete\n", (int)level);
            }
        } while (level >= 0);
    }
    fclose(stream);
    check(b2p_decoding_finish(decoding, message, sizeof message));

    b2p_gaussians *gaussians = NULL;
    check(b2p_decoding_gaussians(decoding, &gaussians, message, sizeof message));
    b2p_decoding_free(decoding);
    b2p_arrays arrays;
    check(b2p_gaussians_arrays(gaussians, &arrays, message, sizeof message));
    printf("%zu Gaussians\n", arrays.count);

    b2p_camera camera = {20, 20, 2.6, 45, 640, 480, {1, 1, 1}, false};
    size_t pixels = (size_t)camera.width * camera.height;
    uint8_t *rgba = malloc(4 * pixels);
    if (rgba == NULL) {
        fprintf(stderr, "out of memory\n");
        return 1;
    }
    check(b2p_render(gaussians, &camera, NULL, rgba, 4 * pixels, message, sizeof message));
    b2p_gaussians_free(gaussians);
    FILE *picture = open_file(arguments[2], "wb");
    fprintf(picture, "P6\n%u %u\n255\n", camera.width, camera.height);
    for (size_t i = 0; i < pixels; i++) {
        fwrite(rgba + 4 * i, 1, 3, picture);
    }
    free(rgba);
    return fclose(picture) == 0 ? 0 : 1;
}
