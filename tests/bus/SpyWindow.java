// Opens lcm-spy's own window on a bus and tells what it shows: `java -cp ... SpyWindow.java URL N FOLDER`.
// Waits until N channels are listed, opens the viewer of each as a double click does, and prints a line for each:
// channel, type, messages that could not be decoded. Paints every window into FOLDER until
// all show text.

import java.awt.Component;
import java.awt.Container;
import java.awt.Frame;
import java.awt.Window;
import java.awt.event.MouseEvent;
import java.awt.image.BufferedImage;
import java.io.File;
import javax.imageio.ImageIO;
import javax.swing.JTable;
import javax.swing.SwingUtilities;

public class SpyWindow {
    static final int CHANNEL = 0, TYPE = 1, UNDECODABLE = 7; // columns of lcm-spy's table
    static final long LIMIT_MS = 90_000;
    static final int TITLE_PX = 40, LEAST_DARK_PX = 500; // of a window that shows text below its title

    static JTable table(Component within) {
        if (within instanceof JTable) return (JTable) within;
        if (within instanceof Container)
            for (Component child : ((Container) within).getComponents()) {
                JTable found = table(child);
                if (found != null) return found;
            }
        return null;
    }

    static JTable table() {
        for (Frame frame : Frame.getFrames()) {
            JTable found = table(frame);
            if (found != null) return found;
        }
        return null;
    }

    static void open(JTable rows, int row) throws Exception {
        int[] click = {MouseEvent.MOUSE_PRESSED, MouseEvent.MOUSE_RELEASED, MouseEvent.MOUSE_CLICKED};
        SwingUtilities.invokeAndWait(() -> {
            rows.setRowSelectionInterval(row, row);
            int y = rows.getCellRect(row, 0, true).y + 2;
            for (int part : click)
                rows.dispatchEvent(new MouseEvent(rows, part, 0, 0, 3, y, 2, false, MouseEvent.BUTTON1));
        });
    }

    // Paint every window into `folder`; how many of them show text.
    static int paint(String folder) throws Exception {
        int written = 0;
        for (Window window : Window.getWindows()) {
            if (!(window instanceof Frame) || !window.isVisible() || window.getWidth() < 1) continue;
            BufferedImage image =
                    new BufferedImage(window.getWidth(), window.getHeight(), BufferedImage.TYPE_INT_RGB);
            SwingUtilities.invokeAndWait(() -> window.printAll(image.getGraphics()));
            ImageIO.write(image, "png", new File(folder, ((Frame) window).getTitle() + ".png"));
            int dark = 0;
            for (int y = TITLE_PX; y < image.getHeight(); y++)
                for (int x = 0; x < image.getWidth(); x++)
                    if ((image.getRGB(x, y) & 0xc0c0c0) == 0) dark++;
            if (dark > LEAST_DARK_PX) written++;
        }
        return written;
    }

    public static void main(String[] words) throws Exception {
        int wanted = Integer.parseInt(words[1]);
        lcm.spy.Spy.main(new String[] {"--lcm-url=" + words[0]});
        JTable table = null;
        long limit = System.currentTimeMillis() + LIMIT_MS;
        while (table == null || table.getRowCount() < wanted) {
            if (System.currentTimeMillis() > limit) throw new RuntimeException("not all channels were listed");
            Thread.sleep(50);
            table = table();
        }
        for (int row = 0; row < wanted; row++) open(table, row);
        int written = 0;
        while (written < wanted + 1 && System.currentTimeMillis() < limit) {
            Thread.sleep(200);
            written = paint(words[2]);
        }
        for (int row = 0; row < wanted; row++)
            System.out.println(table.getValueAt(row, CHANNEL) + "\t" + table.getValueAt(row, TYPE) + "\t"
                    + table.getValueAt(row, UNDECODABLE));
        System.out.println(written + " windows show text");
        System.out.flush();
        Runtime.getRuntime().halt(0);
    }
}
